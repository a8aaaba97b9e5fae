// A candidate's trajectory. packed: gravity, then a body's 21 numbers each, then a pair's 6; plan: first, second, kind, slot.

CUDA_CALLABLE void read(const float* packed, const int* plan) {
    EACH(i, BODIES) {
        const float* in = packed + 3 + 21 * i;
        Body& b = room.body[i];
        for (int k = 0; k < 3; k++) b.size[k] = in[k];
        b.mass = in[3];
        for (int k = 0; k < 3; k++) b.inertia[k] = in[4 + k];
        b.lightness = in[7];
        for (int k = 0; k < 3; k++) b.pos[k] = in[8 + k];
        for (int k = 0; k < 4; k++) b.quat[k] = in[11 + k];
        for (int k = 0; k < 6; k++) b.vel[k] = in[15 + k];
        for (int k = 0; k < 6; k++) room.last[6 * i + k] = 0.0f;
    }
    EACH(p, PAIRS) {
        const float* in = packed + 3 + 21 * BODIES + 6 * p;
        room.surface[p] = {in[0], in[1], in[2], in[3], in[4], in[5]};
        room.pair[p] = {plan[4 * p], plan[4 * p + 1], plan[4 * p + 2], plan[4 * p + 3]};
        int end = p + 1 < PAIRS ? plan[4 * p + 7] : SPOTS;
        for (int s = plan[4 * p + 3]; s < end; s++) room.spot[s].pair = p;
    }
    EACH(i, 12) for (int j = 0; j <= i; j++) {
        room.line[i * (i + 1) / 2 + j] = i;
        room.column[i * (i + 1) / 2 + j] = j;
    }
    SYNC;
}

CUDA_CALLABLE void write(float* poses) {
    EACH(i, BODIES) {
        for (int k = 0; k < 3; k++) poses[7 * i + k] = room.body[i].pos[k];
        for (int k = 0; k < 4; k++) poses[7 * i + 3 + k] = room.body[i].quat[k];
    }
    SYNC;
}

CUDA_CALLABLE void run(const float* packed, const int* plan, float* poses, int frames, float dt) {
    read(packed, plan);
    write(poses);
    for (int frame = 1; frame < frames; frame++) {
        for (int k = 0; k < SUBSTEPS; k++) {
            place(packed);
            SYNC;
            collide();
            gather();
            accelerate();
            move(dt);
        }
        write(poses + 7 * BODIES * frame);
    }
}
