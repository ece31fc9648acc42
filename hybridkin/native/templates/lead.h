    @REAL@ hysteresis[@LEAD@]; /* its state; the last @N@ numbers are what the actuators do */
