/* @NAME@ as a functional mock-up unit: FMI 3.0, co-simulation. Written by hybridkin @VERSION@.

   Compile this file alone, as a shared library; it includes @NAME@.c. */
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "@NAME@.c"

#if defined(_WIN32)
#define FMI __declspec(dllexport)
#elif defined(__GNUC__)
#define FMI __attribute__((visibility("default")))
#else
#define FMI
#endif

enum { FMI_OK = 0, FMI_ERROR = 3 }; /* of fmi3Status */

typedef void log_t(void *environment, int status, const char *category, const char *message);

/* Where a variable begins among the values of an instance, in the order of modelDescription.xml. */
enum { @OFFSETS@ };

/* Who may set a variable: nobody, before the first step, always. */
enum { NEVER, BEFORE, ALWAYS };

/* By value reference, from 1 on; the time has 0. Numbers must lie within low and high, unless there
   is no need to. */
static const struct {
    const char *name;
    int begin, size, may_be_set;
    double low, high;
    const char *need;
} variables[] = {{"time", 0, 1, NEVER, 0.0, 0.0, NULL}, @VARIABLES@};

enum { VARIABLES = sizeof variables / sizeof *variables };

static const double start_values[VALUES] = {@STARTS_OF_VALUES@};

/* What an instance may do next. */
typedef enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED } phase_t;

typedef struct {
    void *environment;
    log_t *log;
    double values[VALUES], time;
    phase_t mode;
    @INSTANCE@
} instance_t;

/* Tell the importer what is wrong, and return the status for it. The instance stays as it was. */
static int refused(const instance_t *unit, const char *format, ...) {
    char message[300];
    va_list words;
    va_start(words, format);
    vsnprintf(message, sizeof message, format, words);
    va_end(words);
    if (unit && unit->log) unit->log(unit->environment, FMI_ERROR, "logStatusError", message);
    return FMI_ERROR;
}

@UPDATE@

/* Check that values can be set, all of them before any is. */
static int check_values(const instance_t *unit, uint32_t r, const double *values) {
    const char *name = variables[r].name;
    if (variables[r].may_be_set == NEVER) return refused(unit, "%s cannot be set", name);
    if (unit->mode == TERMINATED)
        return refused(unit, "%s cannot be set after the end of the simulation", name);
    if (variables[r].may_be_set == BEFORE && unit->mode == STEPPING)
        return refused(unit, "%s cannot be set after the initialization", name);
    for (int i = 0; variables[r].need && i < variables[r].size; i++)
        if (!(values[i] >= variables[r].low && values[i] <= variables[r].high))
            return refused(unit, "%s must be %s, got %g", name, variables[r].need, values[i]);
    return FMI_OK;
}

static int read_or_write(instance_t *unit, const uint32_t references[], size_t n_references,
                         double values[], size_t n_values, int writes) {
    size_t at = 0;
    for (size_t k = 0; k < n_references; k++) {
        const uint32_t r = references[k];
        if (r >= VARIABLES)
            return refused(unit, "there is no variable with the value reference %lu",
                           (unsigned long)r);
        if ((size_t)variables[r].size > n_values - at)
            return refused(unit, "%s has %d values, got %lu", variables[r].name, variables[r].size,
                           (unsigned long)(n_values - at));
        if (writes && check_values(unit, r, values + at)) return FMI_ERROR;
        at += (size_t)variables[r].size;
    }
    if (at < n_values)
        return refused(unit, "the variables have %lu values, got %lu", (unsigned long)at,
                       (unsigned long)n_values);
    for (size_t k = 0; k < n_references; k++) {
        const uint32_t r = references[k];
        const size_t size = (size_t)variables[r].size * sizeof *values;
        double *place = r ? unit->values + variables[r].begin : &unit->time;
        memcpy(writes ? place : values, writes ? values : place, size);
        values += variables[r].size;
    }
    return FMI_OK;
}

FMI const char *fmi3GetVersion(void) { return "3.0"; }

FMI int fmi3SetDebugLogging(void *unit, bool on, size_t n, const char *const categories[]) {
    (void)unit, (void)on, (void)n, (void)categories;
    return FMI_OK;
}

FMI int fmi3Reset(void *unit) {
    instance_t *all = unit;
    const instance_t fresh = {.environment = all->environment, .log = all->log};
    *all = fresh;
    memcpy(all->values, start_values, sizeof start_values);
    return FMI_OK;
}

FMI void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                      bool visible, bool logging, bool events, bool early,
                                      const uint32_t between[], size_t n_between,
                                      void *environment, log_t *log, void *update) {
    const instance_t caller = {.environment = environment, .log = log};
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
    (void)between, (void)n_between, (void)update;
    if (!token || strcmp(token, "@TOKEN@")) {
        refused(&caller, "the instantiation token is that of another modelDescription.xml");
        return NULL;
    }
    instance_t *unit = malloc(sizeof *unit);
    if (unit) {
        *unit = caller;
        fmi3Reset(unit);
    }
    return unit;
}

FMI void fmi3FreeInstance(void *unit) { free(unit); }

FMI int fmi3EnterInitializationMode(void *unit, bool tolerance_defined, double tolerance,
                                    double start, bool stop_defined, double stop) {
    instance_t *all = unit;
    (void)tolerance_defined, (void)tolerance;
    if (all->mode != INSTANTIATED) return refused(all, "the simulation has begun; reset it");
    if (!isfinite(start) || (stop_defined && !(stop >= start)))
        return refused(all, "the simulation must start at a finite time and stop after it, got %g"
                       " and %g", start, stop_defined ? stop : INFINITY);
    all->time = start;
    all->mode = INITIALIZING;
    return FMI_OK;
}

FMI int fmi3ExitInitializationMode(void *unit) {
    instance_t *all = unit;
    if (all->mode != INITIALIZING) return refused(all, "the initialization has not begun");
    if (check_together(all)) return FMI_ERROR;
    start_unit(all);
    all->mode = STEPPING;
    return FMI_OK;
}

FMI int fmi3EnterStepMode(void *unit) {
    const instance_t *all = unit;
    return all->mode == STEPPING ? FMI_OK : refused(all, "steps follow the initialization");
}

FMI int fmi3Terminate(void *unit) {
    instance_t *all = unit;
    if (all->mode != STEPPING) return refused(all, "the simulation has not begun");
    all->mode = TERMINATED;
    return FMI_OK;
}

FMI int fmi3GetFloat64(void *unit, const uint32_t references[], size_t n_references,
                       double values[], size_t n_values) {
    instance_t *all = unit;
    if (all->mode < STEPPING) start_unit(all); /* what depends on the start values so far */
    return read_or_write(all, references, n_references, values, n_values, 0);
}

FMI int fmi3SetFloat64(void *unit, const uint32_t references[], size_t n_references,
                       const double values[], size_t n_values) {
    return read_or_write(unit, references, n_references, (double *)values, n_values, 1);
}

FMI int fmi3DoStep(void *unit, double time, double step, bool no_return, bool *event,
                   bool *terminate, bool *early, double *last) {
    instance_t *all = unit;
    (void)no_return;
    *event = *terminate = *early = false;
    *last = all->time;
    if (all->mode != STEPPING) return refused(all, "steps follow the initialization");
    if (!isfinite(time)) return refused(all, "the time must be finite, got %g", time);
    if (!(step > 0.0 && isfinite(time + step)))
        return refused(all, "a step must be positive and finite, got %g s", step);
    if (check_together(all) || step_unit(all, step)) return FMI_ERROR;
    all->time = *last = time + step;
    return FMI_OK;
}

FMI int fmi3GetFMUState(void *unit, void **state) {
    if (!*state) *state = malloc(sizeof(instance_t));
    if (!*state) return refused(unit, "there is no memory for the state");
    memcpy(*state, unit, sizeof(instance_t));
    return FMI_OK;
}

FMI int fmi3SetFMUState(void *unit, void *state) {
    instance_t *all = unit;
    if (!state) return refused(all, "there is no state to return to");
    const instance_t caller = {.environment = all->environment, .log = all->log};
    memcpy(all, state, sizeof *all);
    all->environment = caller.environment;
    all->log = caller.log;
    return FMI_OK;
}

FMI int fmi3FreeFMUState(void *unit, void **state) {
    (void)unit;
    free(*state);
    *state = NULL;
    return FMI_OK;
}

/* Types and modes that this unit does not have. */
#define NO_TYPE(type, of)                                                                        \
    FMI int fmi3Get##type(void *i, const uint32_t r[], size_t n, of v[], size_t m) {             \
        (void)r, (void)v;                                                                        \
        return n || m ? refused(i, "all variables are Float64, none is " #type) : FMI_OK;        \
    }                                                                                            \
    FMI int fmi3Set##type(void *i, const uint32_t r[], size_t n, const of v[], size_t m) {       \
        (void)r, (void)v;                                                                        \
        return n || m ? refused(i, "all variables are Float64, none is " #type) : FMI_OK;        \
    }
NO_TYPE(Float32, float)
NO_TYPE(Int8, int8_t)
NO_TYPE(UInt8, uint8_t)
NO_TYPE(Int16, int16_t)
NO_TYPE(UInt16, uint16_t)
NO_TYPE(Int32, int32_t)
NO_TYPE(UInt32, uint32_t)
NO_TYPE(Int64, int64_t)
NO_TYPE(UInt64, uint64_t)
NO_TYPE(Boolean, bool)
NO_TYPE(String, char *)

#define REFUSED(function)                                                                        \
    FMI int function(void) { return FMI_ERROR; }
REFUSED(fmi3EnterEventMode)
REFUSED(fmi3GetBinary)
REFUSED(fmi3GetClock)
REFUSED(fmi3SetBinary)
REFUSED(fmi3SetClock)
REFUSED(fmi3GetNumberOfVariableDependencies)
REFUSED(fmi3GetVariableDependencies)
REFUSED(fmi3SerializedFMUStateSize)
REFUSED(fmi3SerializeFMUState)
REFUSED(fmi3DeserializeFMUState)
REFUSED(fmi3GetDirectionalDerivative)
REFUSED(fmi3GetAdjointDerivative)
REFUSED(fmi3EnterConfigurationMode)
REFUSED(fmi3ExitConfigurationMode)
REFUSED(fmi3GetIntervalDecimal)
REFUSED(fmi3GetIntervalFraction)
REFUSED(fmi3GetShiftDecimal)
REFUSED(fmi3GetShiftFraction)
REFUSED(fmi3SetIntervalDecimal)
REFUSED(fmi3SetIntervalFraction)
REFUSED(fmi3SetShiftDecimal)
REFUSED(fmi3SetShiftFraction)
REFUSED(fmi3EvaluateDiscreteStates)
REFUSED(fmi3UpdateDiscreteStates)
REFUSED(fmi3EnterContinuousTimeMode)
REFUSED(fmi3CompletedIntegratorStep)
REFUSED(fmi3SetTime)
REFUSED(fmi3SetContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives)
REFUSED(fmi3GetEventIndicators)
REFUSED(fmi3GetContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates)
REFUSED(fmi3GetOutputDerivatives)
REFUSED(fmi3ActivateModelPartition)
FMI void *fmi3InstantiateModelExchange(void) { return NULL; }
FMI void *fmi3InstantiateScheduledExecution(void) { return NULL; }
