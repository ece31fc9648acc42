
/* Move obstacle i, counted from 0, before a step. Its 19 numbers, as `numbers` of an obstacle in Python:
   center (3), axes (3, 3), low and high sides along them (3 each), radius; in metres and finite, but
   sides, which may be infinite. */
void @NAME@_obstacle(@NAME@_state *state, int i, const @REAL@ *numbers);
