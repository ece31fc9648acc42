    @REAL@ obstacles[@OBSTACLE_NUMBERS@]; /* where they are now, 19 numbers each */
    unsigned char blocked;   /* whether obstacles, or the body itself, changed the step */
