%   state = @NAME@('reset', q) is the state of a controller at rest at q.
%
%   [q, state, error, held] = @NAME@('step', state, target, velocity, measured) is one period of
%   @DT@ s: the next command q (@N@ x 1) within the limits, the new state, the distance [m] of the
%   tip from the target (@WIDTH@ numbers) before this step, and the actuators held at a limit. The
%   velocity (@TASK@ numbers [m/s]) and the measured tip (@WIDTH@ numbers) may be [].
%
