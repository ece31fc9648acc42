%   state = @NAME@('reset', q) is the state of a controller at rest at q.
%
%   [q, state, error, held, rejected] = @NAME@('step', state, target, velocity, measured, age) is
%   one period of @DT@ s: the next command q (@N@ x 1) within the limits, the new state, the distance
%   [m] of the tip from the target (@WIDTH@ numbers) before this step, the actuators held at a limit,
%   and whether the measured tip was not used, as it is not plausible. The velocity (@TASK@ numbers
%   [m/s]) and the measured tip (@WIDTH@ numbers) may be []; its age [s] is at first 0, then as
%   before.
%
@CLEAR_HELP@