%   Steps have a sixth result, blocked: whether obstacles changed the step.
%   state = @NAME@('obstacle', state, i, numbers) moves obstacle i (1 to @OBSTACLES@) before a step. Its 19
%   numbers are center (3), axes (3 x 3, row by row), low and high sides along them (3 each), radius.
%
