// A step: contacts, the convex problem that gives the acceleration, and the Euler integration, as in MuJoCo
// (https://mujoco.readthedocs.io/en/stable/computation/index.html): Newton's method with elliptic friction cones.
// Angular velocities are the world's, where MuJoCo's are the bodies': the same problem in other coordinates.

CUDA_CALLABLE static V spin(const Body& b, V w) {  // inertia times a vector
    const float* m = b.spun;
    return {m[0] * w.x + m[1] * w.y + m[2] * w.z, m[1] * w.x + m[4] * w.y + m[5] * w.z,
            m[2] * w.x + m[5] * w.y + m[8] * w.z};
}

// Where bodies are, and how they would accelerate without contacts.
CUDA_CALLABLE void place(const float* gravity) {
    EACH(i, BODIES) {
        Body& b = room.body[i];
        float w = b.quat[0], x = b.quat[1], y = b.quat[2], z = b.quat[3];
        float m[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
                      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)};
        for (int k = 0; k < 9; k++) b.turn.m[k] = m[k];
        for (int r = 0; r < 3; r++)
            for (int c = 0; c < 3; c++) {
                float sum = 0.0f;
                for (int k = 0; k < 3; k++) sum += m[3 * r + k] * b.inertia[k] * m[3 * c + k];
                b.spun[3 * r + c] = sum;
            }
        V own = b.turn.in(load(b.vel + 3));
        V held = {b.inertia[0] * own.x, b.inertia[1] * own.y, b.inertia[2] * own.z}, torque = held.cross(own);
        V turning = b.turn.out({torque.x / b.inertia[0], torque.y / b.inertia[1], torque.z / b.inertia[2]});
        store(room.calm + 6 * i, load(gravity));
        store(room.calm + 6 * i + 3, turning);
    }
}

CUDA_CALLABLE void collide() {
    EACH(s, SPOTS) room.spot[s].distance = 1.0f;
    SYNC;
    EACH(p, PAIRS) alone(p);
    SYNC;
    for (int p = BODIES; p < PAIRS; p++) {
        const Pair& pair = room.pair[p];
        bool both = pair.kind == 7 || pair.kind == 10 || pair.kind == 11;
        if (!both || !near(pair)) continue;
        const Body &a = room.body[pair.first], &b = room.body[pair.second];
        // Only what the scene kind has is compiled.
        if (CYLINDERS && pair.kind == 7) cylinder_cylinder(p, a, b);
        if (CYLINDER_AND_BOX && pair.kind == 10) cylinder_box(p, a, b);
        if (BOXES && pair.kind == 11) box_box(p, a, b);
        SYNC;
    }
    SYNC;
}

// Rows of a contact in the coordinates of its cone, U = (mu a_n, friction a_t...), and what they are to become.
CUDA_CALLABLE void prepare(Contact& c, const Spot& s) {
    const Pair& pair = room.pair[s.pair];
    const Surface& f = room.surface[s.pair];
    float slide = most(f.slide, 1e-5f), torsion = most(f.torsion, 1e-5f), roll = most(f.roll, 1e-5f);
    float scale[6] = {slide, slide, slide, torsion, roll, roll};
    V n = load(s.normal);
    V other = fabsf(n.y) < 0.5f ? V{0, 1, 0} : V{0, 0, 1};
    V t = (other - n * other.dot(n)).unit();
    V axes[3] = {n, t, n.cross(t)};
    c.first = pair.first;
    c.second = pair.second;
    float lightness = 0.0f, velocity[6] = {0, 0, 0, 0, 0, 0};
    for (int side = 0; side < 2; side++) {
        int body = side ? pair.second : pair.first;
        if (body < 0) {
            for (int k = 0; k < 6; k++)
                for (int j = 0; j < 6; j++) c.rows[k][j] = 0.0f;
            continue;
        }
        const Body& b = room.body[body];
        lightness += b.lightness;
        V arm = load(s.point) - b.at();
        float way = side ? 1.0f : -1.0f;
        for (int k = 0; k < 6; k++) {
            V axis = axes[k % 3] * (way * scale[k]);
            float* row = c.rows[k] + 6 * side;
            store(row, k < 3 ? axis : V{0, 0, 0});
            store(row + 3, k < 3 ? arm.cross(axis) : axis);
            for (int j = 0; j < 6; j++) velocity[k] += row[j] * b.vel[j];
        }
    }
    float x = least(fabsf(s.distance) * 1000.0f, 1.0f);
    float impedance = 0.9f + 0.05f * (x <= 0.5f ? 2.0f * x * x : 1.0f - 2.0f * (1.0f - x) * (1.0f - x));
    c.mu = slide;
    c.stiff = impedance / most((1.0f - impedance) * lightness, 1e-15f) / (slide * slide);
    c.wanted[0] = -f.damping / 0.95f * velocity[0] - f.stiffness / 0.9025f * impedance * s.distance * slide;
    for (int k = 1; k < 6; k++) c.wanted[k] = -f.drag / 0.95f * velocity[k];
}

CUDA_CALLABLE void gather() {
    int count = 0;
    for (int from = 0; from < SPOTS; from += LANES) {
        int s = from + lane;
        bool touches = s < SPOTS && room.spot[s].distance < 0.0f;
#if defined(__CUDA_ARCH__)
        unsigned all = __ballot_sync(0xffffffffu, touches);
        int at = count + __popc(all & ((1u << lane) - 1u));
        count += __popc(all);
#else
        int at = count;
        count += touches;
#endif
        if (touches && at < CONTACTS) prepare(room.contact[at], room.spot[s]);
    }
    room.count = count < CONTACTS ? count : CONTACTS;
    SYNC;
}

CUDA_CALLABLE float product(const Contact& c, const float* row, const float* x) const {
    float sum = 0.0f;
    const float* second = x + 6 * c.second;
    for (int j = 0; j < 6; j++) sum += row[6 + j] * second[j];
    if (c.first >= 0) {
        const float* first = x + 6 * c.first;
        for (int j = 0; j < 6; j++) sum += row[j] * first[j];
    }
    return sum;
}

// Slope along v, and curvature, of a contact's cost at u + t v.
CUDA_CALLABLE static void along(const Contact& c, float t, float& slope, float& bend) {
    float u[6], length = 0.0f, rate = 0.0f, square = 0.0f;
    for (int k = 0; k < 6; k++) u[k] = c.u[k] + t * c.v[k];
    for (int k = 1; k < 6; k++) {
        length += u[k] * u[k];
        rate += u[k] * c.v[k];
        square += c.v[k] * c.v[k];
    }
    length = sqrtf(length);
    float mu = c.mu;
    if (u[0] >= mu * length) return;
    if (mu * u[0] + length <= 0.0f) {
        slope += c.stiff * (u[0] * c.v[0] + rate);
        bend += c.stiff * (c.v[0] * c.v[0] + square);
        return;
    }
    float stiff = c.stiff / (1.0f + mu * mu), inside = u[0] - mu * length, slip = rate / length;
    float change = c.v[0] - mu * slip;
    slope += stiff * inside * change;
    bend += stiff * (change * change - inside * mu * (square - slip * slip) / length);
}

CUDA_CALLABLE static float price(const Contact& c, const float* u, float* force) {
    float length = 0.0f;
    for (int k = 1; k < 6; k++) length += u[k] * u[k];
    length = sqrtf(length);
    float mu = c.mu;
    if (u[0] >= mu * length) {
        for (int k = 0; k < 6; k++) force[k] = 0.0f;
        return 0.0f;
    }
    if (mu * u[0] + length <= 0.0f) {
        for (int k = 0; k < 6; k++) force[k] = c.stiff * u[k];
        return 0.5f * c.stiff * (u[0] * u[0] + length * length);
    }
    float stiff = c.stiff / (1.0f + mu * mu), inside = u[0] - mu * length;
    force[0] = stiff * inside;
    for (int k = 1; k < 6; k++) force[k] = -mu * force[0] * u[k] / length;
    return 0.5f * stiff * inside * inside;
}

// u of every contact at the acceleration x.
CUDA_CALLABLE void residuals(const float* x) {
    EACH(i, 6 * room.count) {
        Contact& c = room.contact[i / 6];
        c.u[i % 6] = product(c, c.rows[i % 6], x) - c.wanted[i % 6];
    }
    SYNC;
}

// The cost of x.
CUDA_CALLABLE float cost(const float* x) {
    residuals(x);
    float sum = 0.0f, force[6];
    EACH(i, room.count) sum += price(room.contact[i], room.contact[i].u, force);
    EACH(i, BODIES) {
        V a = load(x + 6 * i) - load(room.calm + 6 * i), w = load(x + 6 * i + 3) - load(room.calm + 6 * i + 3);
        sum += 0.5f * (room.body[i].mass * a.square() + w.dot(spin(room.body[i], w)));
    }
    return total(sum);
}

// Zones, and what the Hessian needs of every contact; v is used for forces. Then the slope.
CUDA_CALLABLE void differentiate() {
    EACH(i, room.count) {
        Contact& c = room.contact[i];
        price(c, c.u, c.v);
        float length = 0.0f;
        for (int k = 1; k < 6; k++) length += c.u[k] * c.u[k];
        length = sqrtf(length);
        c.zone = c.u[0] >= c.mu * length ? TOP : (c.mu * c.u[0] + length <= 0.0f ? BOTTOM : MIDDLE);
        c.bend = c.zone == MIDDLE ? c.stiff / (1.0f + c.mu * c.mu) : c.stiff;
        if (c.zone == MIDDLE) {
            c.pull = c.mu * c.u[0] / length;
            for (int j = 0; j < 12; j++) {
                float sum = 0.0f;
                for (int k = 1; k < 6; k++) sum += c.u[k] * c.rows[k][j];
                c.along[j] = sum / length;
            }
        }
    }
    SYNC;
    EACH(i, DOFS) {
        int body = i / 6, j = i % 6;
        const Body& b = room.body[body];
        const float *x = room.acc + 6 * body, *calm = room.calm + 6 * body;
        float sum;
        if (j < 3) {
            sum = b.mass * (x[j] - calm[j]);
        } else {
            const float* row = b.spun + 3 * (j - 3);
            sum = row[0] * (x[3] - calm[3]) + row[1] * (x[4] - calm[4]) + row[2] * (x[5] - calm[5]);
        }
        for (int k = 0; k < room.count; k++) {
            const Contact& c = room.contact[k];
            if (c.zone == TOP || (c.first != body && c.second != body)) continue;
            int column = c.second == body ? 6 + j : j;
            for (int r = 0; r < 6; r++) sum += c.rows[r][column] * c.v[r];
        }
        room.slope[i] = sum;
    }
    SYNC;
}

CUDA_CALLABLE void add(int i, int j, float value) {
    const int wide = DOFS + 1;
    room.hessian[i >= j ? i * wide + j : j * wide + i] += value;
}

// The lower triangle of the Hessian: of the bodies, then of one contact after the other, whose entries the lanes share.
CUDA_CALLABLE void curvature() {
    const int wide = DOFS + 1;
    EACH(e, DOFS * wide) room.hessian[e] = 0.0f;
    SYNC;
    EACH(i, BODIES) {
        const Body& b = room.body[i];
        for (int j = 0; j < 3; j++) room.hessian[(6 * i + j) * wide + 6 * i + j] = b.mass;
        for (int j = 0; j < 3; j++)
            for (int k = 0; k <= j; k++) room.hessian[(6 * i + 3 + j) * wide + 6 * i + 3 + k] = b.spun[3 * j + k];
    }
    EACH(i, DOFS) room.hessian[DOFS * wide + i] = -room.slope[i];
    for (int k = 0; k < room.count; k++) {
        const Contact& c = room.contact[k];
        if (c.zone == TOP) continue;
        SYNC;
        // Of a contact with the floor the second body's columns alone.
        int from = c.first < 0 ? 6 : 0;
        EACH(e, c.first < 0 ? 21 : 78) {
            int i = from + room.line[e], j = from + room.column[e];
            float across = 0.0f, normal = c.rows[0][i] * c.rows[0][j], entry;
            for (int r = 1; r < 6; r++) across += c.rows[r][i] * c.rows[r][j];
            if (c.zone == BOTTOM) {
                entry = normal + across;
            } else {
                float s = c.along[i], t = c.along[j], mu = c.mu;
                entry = normal - mu * (c.rows[0][i] * t + c.rows[0][j] * s) + c.pull * s * t + (mu * mu - c.pull) * across;
            }
            add(i < 6 ? 6 * c.first + i : 6 * c.second + i - 6, j < 6 ? 6 * c.first + j : 6 * c.second + j - 6,
                c.bend * entry);
        }
    }
    SYNC;
}

#if defined(__CUDA_ARCH__) && DOFS < LANES

// Cholesky's factorisation, a row a lane in its registers, with the right side as a last row; then back.
CUDA_CALLABLE void solve() {
    const int wide = DOFS + 1;
    const unsigned all = 0xffffffffu;
    float row[DOFS], x = 0.0f, scale = 1.0f;
#pragma unroll
    for (int j = 0; j < DOFS; j++) row[j] = lane <= DOFS && (j <= lane) ? room.hessian[lane * wide + j] : 0.0f;
#pragma unroll
    for (int k = 0; k < DOFS; k++) {
        float one = rsqrtf(most(__shfl_sync(all, row[k], k), 1e-12f));
        if (lane == k) scale = one;
        row[k] *= one;
#pragma unroll
        for (int j = k + 1; j < DOFS; j++) row[j] -= row[k] * __shfl_sync(all, row[k], j);
    }
    if (lane < DOFS) {
#pragma unroll
        for (int j = 0; j < DOFS; j++)
            if (j <= lane) room.hessian[lane * wide + j] = row[j];
    }
#pragma unroll
    for (int j = 0; j < DOFS; j++) {
        float right = __shfl_sync(all, row[j], DOFS);
        if (lane == j) x = right;
    }
    __syncwarp();
    float below[DOFS];
#pragma unroll
    for (int k = 0; k < DOFS; k++) below[k] = lane < k ? room.hessian[k * wide + lane] : 0.0f;
#pragma unroll
    for (int k = DOFS - 1; k >= 0; k--) {
        float known = __shfl_sync(all, x * scale, k);
        x = lane == k ? known : x - below[k] * known;
    }
    if (lane < DOFS) room.step[lane] = x;
    __syncwarp();
}

#else

// The same in memory.
CUDA_CALLABLE void solve() {
    const int wide = DOFS + 1;
    for (int k = 0; k < DOFS; k++) {
        const float* own = room.hessian + k * wide;
        float sums[(DOFS + LANES) / LANES];
        int m = 0;
        float diagonal = own[k];
        for (int j = 0; j < k; j++) diagonal -= own[j] * own[j];
        float scale = 1.0f / sqrtf(most(diagonal, 1e-12f));
        for (int i = k + 1 + lane; i <= DOFS; i += LANES) {
            const float* row = room.hessian + i * wide;
            float sum = row[k];
            for (int j = 0; j < k; j++) sum -= row[j] * own[j];
            sums[m++] = sum * scale;
        }
        SYNC;
        m = 0;
        for (int i = k + 1 + lane; i <= DOFS; i += LANES) room.hessian[i * wide + k] = sums[m++];
        if (lane == 0) room.hessian[k * wide + k] = 1.0f / scale;
        SYNC;
    }
    float* right = room.hessian + DOFS * wide;
    for (int k = DOFS - 1; k >= 0; k--) {
        const float* own = room.hessian + k * wide;
        float x = right[k] / own[k];
        EACH(j, k) right[j] -= own[j] * x;
        if (lane == 0) room.step[k] = x;
        SYNC;
    }
}

#endif

// How far to go along the step: the zero of the cost's slope there.
CUDA_CALLABLE float length_of_step() {
    float start = 0.0f, bend = 0.0f;
    EACH(i, BODIES) {
        const Body& b = room.body[i];
        V a = load(room.step + 6 * i), w = load(room.step + 6 * i + 3);
        V da = load(room.acc + 6 * i) - load(room.calm + 6 * i), dw = load(room.acc + 6 * i + 3) - load(room.calm + 6 * i + 3);
        V turned = spin(b, w);
        start += b.mass * a.dot(da) + turned.dot(dw);
        bend += b.mass * a.square() + turned.dot(w);
    }
    start = total(start);
    bend = total(bend);
    EACH(i, 6 * room.count) {
        Contact& c = room.contact[i / 6];
        c.v[i % 6] = product(c, c.rows[i % 6], room.step);
    }
    SYNC;
    float first = 0.0f;
    EACH(i, DOFS) first += room.slope[i] * room.step[i];
    first = total(first);
    float low = 0.0f, high = -1.0f, t = 1.0f;
    for (int k = 0; k < LINE; k++) {
        float slope = 0.0f, more = 0.0f;
        EACH(i, room.count) along(room.contact[i], t, slope, more);
        slope = total(slope) + start + t * bend;
        more = total(more) + bend;
        if (!(fabsf(slope) > 0.01f * fabsf(first))) break;
        if (slope > 0.0f) high = t;
        else low = t;
        float next = t - slope / most(more, 1e-12f);
        if (next <= low || (high > 0.0f && next >= high)) next = high > 0.0f ? 0.5f * (low + high) : 2.0f * t;
        t = next;
    }
    return t;
}

CUDA_CALLABLE void accelerate() {
    if (room.count == 0) {
        EACH(i, DOFS) room.acc[i] = room.calm[i];
        SYNC;
        return;
    }
    // From the last step's accelerations where they are better than none of contacts'.
    float cold = cost(room.calm), warm = cost(room.last);
    bool warmer = warm < cold;
    EACH(i, DOFS) room.acc[i] = warmer ? room.last[i] : room.calm[i];
    SYNC;
    if (!warmer) residuals(room.calm);
    float scale = 0.0f;
    EACH(i, BODIES) scale += 3.0f * room.body[i].mass + room.body[i].inertia[0] + room.body[i].inertia[1] + room.body[i].inertia[2];
    scale = 1.0f / total(scale);
    for (int k = 0; k < NEWTON; k++) {
        differentiate();
        curvature();
        solve();
        float decrement = 0.0f;
        EACH(i, DOFS) decrement -= room.slope[i] * room.step[i];
        decrement = total(decrement) * scale;
        if (!(decrement > TOLERANCE)) break;
        float t = length_of_step();
        EACH(i, DOFS) room.acc[i] += t * room.step[i];
        EACH(i, 6 * room.count) room.contact[i / 6].u[i % 6] += t * room.contact[i / 6].v[i % 6];
        SYNC;
    }
}

CUDA_CALLABLE void move(float dt) {
    EACH(i, BODIES) {
        Body& b = room.body[i];
        for (int j = 0; j < 6; j++) b.vel[j] += dt * room.acc[6 * i + j];
        for (int j = 0; j < 3; j++) b.pos[j] += dt * b.vel[j];
        V w = load(b.vel + 3);
        // Half the angle of a step is small: cosine and sine by their series.
        float h = 0.25f * dt * dt * w.square();
        float c = 1.0f - h * (0.5f - h * (1.0f / 24.0f - h / 720.0f));
        float s = 0.5f * dt * (1.0f - h * (1.0f / 6.0f - h * (1.0f / 120.0f - h / 5040.0f)));
        float x = w.x * s, y = w.y * s, z = w.z * s, *q = b.quat;
        float p[4] = {c * q[0] - x * q[1] - y * q[2] - z * q[3], c * q[1] + x * q[0] + y * q[3] - z * q[2],
                      c * q[2] + y * q[0] + z * q[1] - x * q[3], c * q[3] + z * q[0] + x * q[2] - y * q[1]};
        float length = sqrtf(p[0] * p[0] + p[1] * p[1] + p[2] * p[2] + p[3] * p[3]);
        for (int j = 0; j < 4; j++) q[j] = p[j] / length;
    }
    EACH(i, DOFS) room.last[i] = room.acc[i];
    SYNC;
}
