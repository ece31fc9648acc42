    if (!strcmp(command, "obstacle") && n_in == 4) {
        obstacle(out, in);
        return;
    }
