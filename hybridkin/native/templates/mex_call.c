    char command[16] = "";
    if (n_in > 1 && mxIsChar(in[0])) mxGetString(in[0], command, sizeof command);
    if (!strcmp(command, "reset") && n_in == 2) {
        reset(out, in[1]);
        return;
    }
    if (!strcmp(command, "step") && n_in >= 3 && n_in <= 6) {
        step(n_out, out, n_in, in);
        return;
    }
@CLEAR_CALL@