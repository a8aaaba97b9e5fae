// Contacts of a pair that one lane finds alone: with the floor, and of spheres. As in colliders/plane.py and sphere.py.

Room& room;
const int lane;

CUDA_CALLABLE void touch(int pair, int k, float distance, V point, V normal) {
    Spot& s = room.spot[room.pair[pair].slot + k];
    s.distance = distance;
    store(s.point, point);
    store(s.normal, normal);
}

CUDA_CALLABLE void floor_sphere(int p, const Body& b) {
    float gap = b.pos[2] - b.size[0];
    touch(p, 0, gap, b.at() - V{0, 0, b.size[0] + 0.5f * gap}, {0, 0, 1});
}

CUDA_CALLABLE void floor_box(int p, const Body& b) {
    for (int k = 0; k < 4; k++) {
        V arm = b.turn.out({(k & 1 ? 1.0f : -1.0f) * b.size[0], (k & 2 ? 1.0f : -1.0f) * b.size[1], -b.size[2]});
        if (arm.z > 0.0f) arm = -arm;
        float gap = b.pos[2] + arm.z;
        touch(p, k, gap, b.at() + arm - V{0, 0, 0.5f * gap}, {0, 0, 1});
    }
}

CUDA_CALLABLE void floor_cylinder(int p, const Body& b) {
    V axis = b.turn.axis(2);
    if (axis.z > 0.0f) axis = -axis;
    V down = axis * axis.z - V{0, 0, 1};
    down = (down.square() < 1e-12f ? b.turn.axis(0) : down.unit()) * b.size[0];
    V side = down.cross(axis) * 0.8660254f;
    axis = axis * b.size[1];
    V lowest = down + axis;
    bool touches = b.pos[2] + lowest.z <= 0.0f;
    V arms[4] = {lowest, down - axis, side + axis - down * 0.5f, axis - side - down * 0.5f};
    for (int k = 0; k < 4; k++) {
        float gap = b.pos[2] + arms[k].z;
        touch(p, k, touches ? gap : most(gap, 1e-3f), b.at() + arms[k] - V{0, 0, 0.5f * gap}, {0, 0, 1});
    }
}

CUDA_CALLABLE void sphere_sphere(int p, const Body& a, const Body& b) {
    V way = b.at() - a.at();
    float length = sqrtf(way.square()), gap = length - a.size[0] - b.size[0];
    V n = way.unit();
    touch(p, 0, gap, a.at() + n * (a.size[0] + 0.5f * gap), n);
}

CUDA_CALLABLE void sphere_box(int p, const Body& a, const Body& b) {
    float radius = a.size[0];
    V centre = b.turn.in(a.at() - b.at());
    V nearest = {clip(centre.x, -b.size[0], b.size[0]), clip(centre.y, -b.size[1], b.size[1]),
                 clip(centre.z, -b.size[2], b.size[2])};
    V way = nearest - centre;
    float away = sqrtf(way.square()), gap;
    V n, point;
    if (away <= 1e-9f) {  // inside: out of the nearest face
        float depth = 1e9f;
        int face = 0;
        for (int k = 0; k < 3; k++) {
            float room_left = b.size[k] - fabsf(centre.at(k));
            if (room_left < depth) {
                depth = room_left;
                face = k;
            }
        }
        float s = centre.at(face) >= 0.0f ? -1.0f : 1.0f;
        n = {face == 0 ? s : 0.0f, face == 1 ? s : 0.0f, face == 2 ? s : 0.0f};
        gap = -depth - radius;
        point = centre + n * ((radius - depth) * 0.5f);
    } else {
        n = way * (1.0f / away);
        gap = away - radius;
        point = (nearest + centre + n * radius) * 0.5f;
    }
    touch(p, 0, gap, b.at() + b.turn.out(point), b.turn.out(n));
}

CUDA_CALLABLE void sphere_cylinder(int p, const Body& a, const Body& b) {
    float radius = b.size[0], half = b.size[1];
    V centre = b.turn.in(a.at() - b.at());
    float reach = sqrtf(centre.x * centre.x + centre.y * centre.y), high = fabsf(centre.z);
    bool beside = high < half, over = reach < radius, cap_nearer = half - high < radius - reach;
    V side = reach > 0.0f ? V{centre.x / reach, centre.y / reach, 0.0f} : V{1, 0, 0};
    V up = {0, 0, centre.z > 0.0f ? 1.0f : -1.0f};
    V corner = side * radius + up * half - centre;
    float away = sqrtf(corner.square()), surface;
    V n;
    if (beside && (!over || !cap_nearer)) {
        n = -side;
        surface = reach - radius;
    } else if (over) {
        n = -up;
        surface = high - half;
    } else {
        n = away > 0.0f ? corner * (1.0f / away) : -side;
        surface = away;
    }
    float gap = surface - a.size[0];
    V point = centre + n * (a.size[0] + 0.5f * gap);
    touch(p, 0, gap, b.at() + b.turn.out(point), b.turn.out(n));
}

// What lanes share out among themselves. Kinds: with the floor 0 sphere, 1 cylinder, 2 box; else 3 + first + 3 * second.
CUDA_CALLABLE bool alone(int p) {
    const Pair& pair = room.pair[p];
    const Body& b = room.body[pair.second];
    const Body& a = room.body[pair.first < 0 ? 0 : pair.first];
    switch (pair.kind) {
        case 0: floor_sphere(p, b); return true;
        case 1: floor_cylinder(p, b); return true;
        case 2: floor_box(p, b); return true;
        case 3: sphere_sphere(p, a, b); return true;
        case 6: sphere_cylinder(p, a, b); return true;
        case 9: sphere_box(p, a, b); return true;
        default: return false;
    }
}

CUDA_CALLABLE static float reach(const Body& b, int shape) {  // of its bounding sphere
    float s = b.size[0] * b.size[0];
    if (shape >= 1) s += b.size[1] * b.size[1];
    if (shape == 2) s += b.size[2] * b.size[2];
    return sqrtf(s);
}

CUDA_CALLABLE bool near(const Pair& pair) const {
    int kind = pair.kind - 3;
    const Body &a = room.body[pair.first], &b = room.body[pair.second];
    float far = reach(a, kind % 3) + reach(b, kind / 3);
    return (b.at() - a.at()).square() < far * far;
}
