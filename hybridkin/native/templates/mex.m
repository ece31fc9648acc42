% @NAME@  @TITLE@ with @N@ actuators, written by hybridkin @VERSION@.
%
%   [x, J, distance] = @NAME@(q) gives the tip x (@M@ x 1) [m] of the actuator vector q (@N@ numbers),
%   the Jacobian J = dx/dq (@M@ x @N@), and the relative distance from the training rows: at most 1
%   inside the domain of the model.
%
@STEP_HELP@%   @ABOUT_Q_HELP@
%
%   Compile once, in the folder of @NAME@.c:
%       mex @NAME@.c                  % MATLAB
%       mkoctfile --mex @NAME@.c      % Octave, in a shell
%   This file holds the help; the compiled file has the same name and is what runs.
error('@NAME@:compile', 'Compile first: mex @NAME@.c (see: help @NAME@)');
