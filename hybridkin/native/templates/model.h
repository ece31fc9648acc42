/* @TITLE@: written by hybridkin @VERSION@. Limits: README.md.

   @ABOUT_Q@ */
#ifndef @GUARD@_H
#define @GUARD@_H

#ifdef __cplusplus
extern "C" {
#endif

enum { @GUARD@_N = @N@, @GUARD@_OUTPUTS = @M@ }; /* lengths of q and of x */

typedef @REAL@ @NAME@_real;

extern const @REAL@ @NAME@_home[@N@]; /* a typical q */

/* x of the actuator vector q. */
void @NAME@_forward(const @REAL@ *q, @REAL@ *x);

/* x and its Jacobian J = dx/dq, one row of @N@ numbers for each entry of x. */
void @NAME@_jacobian(const @REAL@ *q, @REAL@ *x, @REAL@ *J);

/* Relative distance of q from the training rows: at most 1 inside the domain of the model. */
@REAL@ @NAME@_domain(const @REAL@ *q);
@STEP_H@
#ifdef __cplusplus
}
#endif
#endif
