// Contacts of boxes and cylinders with each other: all lanes work on one pair. As in colliders/box_box.py, cylinder_box.py,
// cylinder_cylinder.py and directions.py, which say where each comes from.

CUDA_CALLABLE static V towards(V n, V d) { return n.dot(d) < 0.0f ? -n : n; }

// One of 36 directions on the circle through u and w.
CUDA_CALLABLE static V around(V u, V w, int i) {
    float angle = (i + 0.5f) * 0.17453293f;
    return u * cosf(angle) + w * sinf(angle);
}

CUDA_CALLABLE void keep(int i, V point, bool valid) {
    store(room.point[i], point);
    room.valid[i] = valid;
}

// Of the points from 0 to count the valid ones, four at most: those that span the most area in x and y.
CUDA_CALLABLE int four(int count) {
    SYNC;
    if (lane == 0) {
        int n = 0;
        for (int i = 0; i < count; i++)
            if (room.valid[i]) {
                if (n < 4) room.chosen[n] = i;
                n++;
            }
        room.count = n;
    }
    SYNC;
    int n = room.count;
    if (n <= 4) return n;
    EACH(d, 8) {
        float x = cosf(0.78539816f * d), y = sinf(0.78539816f * d), best = -1e30f;
        for (int i = 0; i < count; i++) {
            float far = room.valid[i] ? room.point[i][0] * x + room.point[i][1] * y : -1e30f;
            if (far > best) {
                best = far;
                room.extreme[d] = i;
            }
        }
    }
    SYNC;
    float least_value = 1e30f;
    int code = 0, number = 0;
    for (int a = 0; a < 5; a++)
        for (int b = a + 1; b < 6; b++)
            for (int c = b + 1; c < 7; c++)
                for (int d = c + 1; d < 8; d++, number++) {
                    if (number % LANES != lane) continue;
                    const float *p = room.point[room.extreme[a]], *q = room.point[room.extreme[b]],
                                *r = room.point[room.extreme[c]], *s = room.point[room.extreme[d]];
                    float area = fabsf((p[0] - r[0]) * (q[1] - s[1]) - (p[1] - r[1]) * (q[0] - s[0]));
                    if (-area < least_value) {
                        least_value = -area;
                        code = ((a * 8 + b) * 8 + c) * 8 + d;
                    }
                }
    least_of_all(least_value, code);
    int kept = 0;
    for (int k = 0; k < 4; k++) {  // each once
        int i = room.extreme[(code >> (9 - 3 * k)) & 7];
        bool fresh = true;
        for (int m = 0; m < kept; m++) fresh = fresh && room.chosen[m] != i;
        SYNC;
        if (fresh) {
            if (lane == 0) room.chosen[kept] = i;
            kept++;
        }
        SYNC;
    }
    return kept;
}

// The part of start + t way, 0 <= t <= 1, below a bound: narrows enter and leave.
CUDA_CALLABLE static void cut(float speed, float left, float& enter, float& leave) {
    if (fabsf(speed) < 1e-9f) {
        if (left < 0.0f) enter = most(enter, 2.0f);
    } else if (speed < 0.0f) {
        enter = most(enter, left / speed);
    } else {
        leave = least(leave, left / speed);
    }
}

CUDA_CALLABLE static void nearest(V p, V u, float half_u, V q, V v, float half_v, V& one, V& other) {
    V gap = q - p;
    float b = u.dot(v), pu = u.dot(gap), qv = v.dot(gap), det = 1.0f - b * b;
    float s = clip(det > 1e-8f ? (pu - b * qv) / det : 0.5f * pu, -half_u, half_u);
    float t = clip(b * s - qv, -half_v, half_v);
    s = clip(pu + b * t, -half_u, half_u);
    one = p + u * s;
    other = q + v * t;
}

// Newton on a great circle around the best of its samples; q, a, b as in directions.least_on_circle.
CUDA_CALLABLE static float refined(float start, float q, float a, float b, float radius) {
    float angle = start, spacing = 0.17453293f;
    for (int k = 0; k < 5; k++) {
        float c = cosf(angle), s = sinf(angle), rho = sqrtf(most(1.0f - q * s * s, 1e-8f));
        float first = -radius * q * s * c / rho - a * s + b * c;
        float second = -radius * q * ((c * c - s * s) / rho + q * s * s * c * c / (rho * rho * rho)) - a * c - b * s;
        float step = second > 1e-6f ? -first / second : (first > 0.0f ? -1.0f : 1.0f) * spacing * 0.125f;
        angle = clip(angle + step, start - spacing, start + spacing);
    }
    return angle;
}

struct CylinderBox {  // in the cylinder's frame
    float radius, half;
    V size, apart;
    Turn turn;
    CUDA_CALLABLE float overlap(V n) const {
        V o = turn.in(n);
        return radius * sqrtf(most(n.x * n.x + n.y * n.y, 1e-20f)) + half * fabsf(n.z) + size.x * fabsf(o.x) +
               size.y * fabsf(o.y) + size.z * fabsf(o.z) - apart.dot(n);
    }
    CUDA_CALLABLE V slope(V n, int without) const {
        V o = turn.in(n);
        V s = {without == 0 ? 0.0f : size.x * sign(o.x), without == 1 ? 0.0f : size.y * sign(o.y),
               without == 2 ? 0.0f : size.z * sign(o.z)};
        return V{0, 0, half * sign(n.z)} + turn.out(s) - apart;
    }
    CUDA_CALLABLE V corner(V n) const {  // of the box, deepest against n
        V o = turn.in(n);
        return apart - turn.out({size.x * sign(o.x), size.y * sign(o.y), size.z * sign(o.z)});
    }
};

// Directions: 0-2 box faces, 3 cap, 4-6 edges, 7-14 corners, 15-17 rim.
CUDA_CALLABLE V candidate(const CylinderBox& c, int i, bool& counts) {
    counts = true;
    if (i < 3) return towards(c.turn.axis(i), c.apart);
    if (i == 3) return towards({0, 0, 1}, c.apart);
    if (i < 7) {
        V cross = V{0, 0, 1}.cross(c.turn.axis(i - 4));
        counts = cross.square() >= 1e-8f;
        return towards(cross.unit(), c.apart);
    }
    int k = i - 7;
    V v = c.apart - c.turn.out({k & 1 ? c.size.x : -c.size.x, k & 2 ? c.size.y : -c.size.y, k & 4 ? c.size.z : -c.size.z});
    return V{v.x, v.y, 0.0f}.unit();
}

CUDA_CALLABLE V rim_direction(const CylinderBox& c, int k, bool& counts) {
    V pole = c.turn.axis(k), u = V{0, 0, 1}.cross(pole);
    counts = u.square() >= 1e-8f;
    u = u.unit();
    V w = pole.cross(u);
    int index = 0;
    SAMPLED(index, 36, c.overlap(around(u, w, i)));
    float start = (index + 0.5f) * 0.17453293f;
    V slope = c.slope(around(u, w, index), k);
    float angle = refined(start, w.z * w.z, slope.dot(u), slope.dot(w), c.radius);
    return u * cosf(angle) + w * sinf(angle);
}

CUDA_CALLABLE V direction(const CylinderBox& c, int& kind, float& depth) {
    depth = 1e30f;
    kind = 0;
    EACH(i, 15) {
        bool counts;
        V n = candidate(c, i, counts);
        float f = counts ? c.overlap(n) : 1e3f;
        if (f < depth) {
            depth = f;
            kind = i;
        }
    }
    least_of_all(depth, kind);
    bool counts;
    V n = candidate(c, kind, counts);
    if (depth <= 0.0f) return n;
    for (int k = 0; k < 3; k++) {
        V rim = rim_direction(c, k, counts);
        float f = c.overlap(rim);
        if (counts && f < depth) {
            depth = f;
            kind = 15 + k;
            n = rim;
        }
    }
    return n;
}

CUDA_CALLABLE V single(const CylinderBox& c, V n, int kind, float depth) {
    V side = V{n.x, n.y, 0.0f}.unit() * c.radius;
    V on_box = c.corner(n);
    if (kind >= 4 && kind < 7) {
        int k = kind - 4;
        V edge = c.turn.axis(k), one, other;
        V middle = on_box + edge * (c.size.at(k) * sign(n.dot(edge)));
        nearest(side, {0, 0, 1}, c.half, middle, edge, c.size.at(k), one, other);
        return (one + other) * 0.5f;
    }
    if (kind == 3 || (kind >= 7 && kind < 15)) return on_box + n * (0.5f * depth);
    return side + V{0, 0, c.half * sign(n.z)} - n * (0.5f * depth);
}

CUDA_CALLABLE V facing_normal(const CylinderBox& c, V n, int k) const {  // of the box, towards the cylinder
    V axis = c.turn.axis(k);
    return axis * -sign(n.dot(axis));
}

// The cylinder's side line on a face that it is parallel to: points 0 and 1.
CUDA_CALLABLE bool side_on_face(const CylinderBox& c, V n, V& normal) {
    int k = -1;
    for (int i = 2; i >= 0; i--)
        if (fabsf(c.turn.m[6 + i]) < SQUARE && fabsf(n.dot(c.turn.axis(i))) > 1e-6f) k = i;
    if (k < 0) return false;
    V out = facing_normal(c, n, k), centre = c.apart + out * c.size.at(k);
    V first = c.turn.axis((k + 1) % 3), second = c.turn.axis((k + 2) % 3);
    V start = V{n.x, n.y, 0.0f}.unit() * c.radius - V{0, 0, c.half}, way = {0, 0, 2.0f * c.half};
    float limits[2] = {c.size.at((k + 1) % 3), c.size.at((k + 2) % 3)}, enter = 0.0f, leave = 1.0f;
    V across[2] = {first, second};
    for (int i = 0; i < 2; i++) {
        float at = (start - centre).dot(across[i]), speed = way.dot(across[i]);
        cut(speed, limits[i] - at, enter, leave);
        cut(-speed, limits[i] + at, enter, leave);
    }
    bool found = false;
    V points[2] = {start + way * enter, start + way * leave};
    SYNC;
    for (int i = 0; i < 2; i++) {
        float gap = (points[i] - centre).dot(out);
        bool valid = enter <= leave && gap <= 0.0f;
        found = found || valid;
        if (lane == 0) {
            keep(i, points[i] - out * (0.5f * gap), valid);
            room.gap[i] = gap;
        }
    }
    SYNC;
    normal = -out;
    return found;
}

// Corners of the parallelogram centre +- u +- v cut to a 16-gon around the z axis: points 0 to 23.
CUDA_CALLABLE void face_over_disc(V centre, V u, V v, float radius) {
    float bound = radius * 0.98078528f;
    EACH(s, 4) {
        V start = centre + u * (s == 0 || s == 3 ? 1.0f : -1.0f) + v * (s < 2 ? 1.0f : -1.0f);
        int e = (s + 1) % 4;
        V way = centre + u * (e == 0 || e == 3 ? 1.0f : -1.0f) + v * (e < 2 ? 1.0f : -1.0f) - start;
        float enter = 0.0f, leave = 1.0f;
        for (int k = 0; k < 16; k++) {
            float x = cosf((k + 0.5f) * 0.39269908f), y = sinf((k + 0.5f) * 0.39269908f);
            cut(way.x * x + way.y * y, bound - start.x * x - start.y * y, enter, leave);
        }
        bool inside = enter <= leave;
        keep(s, start + way * enter, inside);
        keep(4 + s, start + way * leave, inside && leave < 1.0f && leave > enter);
    }
    float area = u.x * v.y - u.y * v.x;
    if (fabsf(area) < 1e-12f) area = 1e-12f;
    EACH(k, 16) {
        float x = radius * cosf(k * 0.39269908f), y = radius * sinf(k * 0.39269908f);
        float ox = x - centre.x, oy = y - centre.y;
        float on_u = (ox * v.y - oy * v.x) / area, on_v = (oy * u.x - ox * u.y) / area;
        keep(8 + k, {x, y, centre.z + on_u * u.z + on_v * v.z}, fabsf(on_u) < 1.0f && fabsf(on_v) < 1.0f);
    }
}

// Points whose feet lie on a cap at height up * half, and the distances to it along a normal.
CUDA_CALLABLE int feet(int p, int count, float up, float half, V out, const Body& frame) {
    SYNC;
    EACH(i, count) if (up * room.point[i][2] > half) room.valid[i] = 0;
    int n = four(count);
    for (int k = lane; k < n; k += LANES) {
        V point = load(room.point[room.chosen[k]]), foot = {point.x, point.y, up * half};
        float gap = (foot - point).dot(out);
        touch(p, k, gap, frame.at() + frame.turn.out(foot - out * (0.5f * gap)), frame.turn.out(-out));
    }
    return n;
}

CUDA_CALLABLE void cylinder_box(int p, const Body& a, const Body& b) {
    CylinderBox c = {a.size[0], a.size[1], load(b.size), a.turn.in(b.at() - a.at()), a.turn.between(b.turn)};
    int kind;
    float depth;
    V n = direction(c, kind, depth);
    if (depth <= 0.0f) return;
    float up = sign(n.z), facing = 1.0f;
    int face = 0;
    for (int k = 0; k < 3; k++) {
        float f = fabsf(n.dot(c.turn.axis(k))) > SQUARE ? up * facing_normal(c, n, k).z : 1.0f;
        if (f < facing) {
            facing = f;
            face = k;
        }
    }
    if (facing < -ALIGNED && fabsf(n.z) > SQUARE) {
        V out = facing_normal(c, n, face), centre = c.apart + out * c.size.at(face);
        int i = (face + 1) % 3, j = (face + 2) % 3;
        face_over_disc(centre, c.turn.axis(i) * c.size.at(i), c.turn.axis(j) * c.size.at(j), c.radius);
        if (feet(p, 24, up, c.half, out, a)) return;
    }
    V normal;
    if (side_on_face(c, n, normal)) {
        EACH(i, 2) if (room.valid[i])
            touch(p, i, room.gap[i], a.at() + a.turn.out(load(room.point[i])), a.turn.out(normal));
        return;
    }
    if (lane == 0) touch(p, 0, -depth, a.at() + a.turn.out(single(c, n, kind, depth)), a.turn.out(n));
}

struct Cylinders {  // in the first one's frame
    float r1, h1, r2, h2;
    Turn turn;
    V apart, axis;
    CUDA_CALLABLE float overlap(V n) const {
        float along = n.dot(axis);
        return r1 * sqrtf(most(1.0f - n.z * n.z, 1e-12f)) + h1 * fabsf(n.z) +
               r2 * sqrtf(most(1.0f - along * along, 1e-12f)) + h2 * fabsf(along) - apart.dot(n);
    }
};

CUDA_CALLABLE static V across(V n, V axis) { return n - axis * n.dot(axis); }

// The least overlap on the circle around a pole, where the other cylinder's rim touches.
CUDA_CALLABLE V on_circle(const Cylinders& c, V pole, V axis, float radius, bool of_second) {
    V u = axis.cross(pole).unit(), w = pole.cross(u);
    int index = 0;
    SAMPLED(index, 36, c.overlap(around(u, w, i)));
    float start = (index + 0.5f) * 0.17453293f, along = w.dot(axis);
    V n = around(u, w, index);
    V slope = (of_second ? c.axis * (c.h2 * sign(n.dot(c.axis))) : V{0, 0, c.h1 * sign(n.z)}) - c.apart;
    float angle = refined(start, along * along, slope.dot(u), slope.dot(w), radius);
    return u * cosf(angle) + w * sinf(angle);
}

CUDA_CALLABLE static V fibonacci(int i) {
    float k = i + 0.5f, z = 1.0f - 2.0f * k / 160.0f, angle = 10.166407f * k, s = sqrtf(1.0f - z * z);
    return {s * cosf(angle), s * sinf(angle), z};
}

// Where both touch with a rim: directions.least_smooth.
CUDA_CALLABLE V on_rims(const Cylinders& c) {
    int index = 0;
    SAMPLED(index, 160, c.overlap(towards(fibonacci(i), c.apart)));
    V n = towards(fibonacci(index), c.apart);
    for (int k = 0; k < 8; k++) {
        V slope = -c.apart, first = n.cross(fabsf(n.x) < 0.7f ? V{1, 0, 0} : V{0, 1, 0}).unit(), second = n.cross(first);
        float h00 = 0, h01 = 0, h11 = 0;
        for (int which = 0; which < 2; which++) {
            V axis = which ? c.axis : V{0, 0, 1};
            float r = which ? c.r2 : c.r1, h = which ? c.h2 : c.h1, along = n.dot(axis);
            V side = across(n, axis);
            float rho = sqrtf(most(side.square(), 1e-8f));
            slope = slope + side * (r / rho) + axis * (h * sign(along));
            float a0 = first.dot(axis), a1 = second.dot(axis), s0 = first.dot(side) / rho, s1 = second.dot(side) / rho;
            h00 += r / rho * (1.0f - a0 * a0 - s0 * s0);
            h01 += r / rho * (-a0 * a1 - s0 * s1);
            h11 += r / rho * (1.0f - a1 * a1 - s1 * s1);
        }
        float value = slope.dot(n), g0 = slope.dot(first), g1 = slope.dot(second);
        h00 -= value;
        h11 -= value;
        float mean = 0.5f * (h00 + h11), spread = sqrtf(0.25f * (h00 - h11) * (h00 - h11) + h01 * h01 + 1e-20f);
        float more = most(0.0f, 0.02f * (c.r1 + c.r2) - (mean - spread));
        h00 += more;
        h11 += more;
        float det = h00 * h11 - h01 * h01, s0 = -(h11 * g0 - h01 * g1) / det, s1 = -(h00 * g1 - h01 * g0) / det;
        float shorter = least(1.0f, 0.2f / sqrtf(s0 * s0 + s1 * s1 + 1e-18f));
        n = (n + first * (s0 * shorter) + second * (s1 * shorter)).unit();
    }
    return n;
}

// Directions: 0, 1 caps, 2 crossing sides, 3, 4 side and rim, 5 rims.
CUDA_CALLABLE V direction(const Cylinders& c, int& kind, float& depth) {
    V up = {0, 0, 1}, cross = up.cross(c.axis);
    bool parallel = cross.square() < 1e-8f;
    depth = 1e30f;
    V best = up;
    for (int i = 0; i < 6; i++) {
        if (parallel && (i == 2 || i == 4)) continue;
        if (i == 3 && depth <= 0.0f) break;
        V n;
        switch (i) {
            case 0: n = towards(up, c.apart); break;
            case 1: n = towards(c.axis, c.apart); break;
            case 2: n = towards(cross.unit(), c.apart); break;
            case 3: n = parallel ? V{c.apart.x, c.apart.y, 0.0f}.unit() : on_circle(c, up, c.axis, c.r2, true); break;
            case 4: n = on_circle(c, c.axis, up, c.r1, false); break;
            default: n = on_rims(c);
        }
        float f = c.overlap(n);
        if (f < depth) {
            depth = f;
            kind = i;
            best = n;
        }
    }
    return best;
}

CUDA_CALLABLE V single(const Cylinders& c, V n, int kind, float depth) {
    V up = {0, 0, 1}, side = across(n, up).unit() * c.r1, line = c.apart - across(n, c.axis).unit() * c.r2;
    if (kind == 2 || (kind == 3 && fabsf(n.dot(c.axis)) < 1e-3f)) {
        V one, other;
        nearest(side, up, c.h1, line, c.axis, c.h2, one, other);
        return (one + other) * 0.5f;
    }
    if (kind == 0 || kind == 3) return line - c.axis * (c.h2 * sign(n.dot(c.axis))) + n * (0.5f * depth);
    return side + up * (c.h1 * sign(n.z)) - n * (0.5f * depth);
}

// A side line cut to a cap: points 0 and 1.
CUDA_CALLABLE bool line_on_cap(V start, V way, V cap, V out, float radius) {
    V flat = across(way, out), at = across(start - cap, out);
    float a = flat.square(), b = flat.dot(at), c = at.square() - radius * radius, inside = b * b - a * c;
    float root = sqrtf(most(inside, 1e-12f));
    a = most(a, 1e-9f);
    float t[2] = {most((-b - root) / a, 0.0f), least((-b + root) / a, 1.0f)};
    bool found = false;
    SYNC;
    for (int i = 0; i < 2; i++) {
        V point = start + way * t[i];
        float gap = (point - cap).dot(out);
        bool valid = t[0] <= t[1] && gap <= 0.0f && inside > 0.0f;
        found = found || valid;
        if (lane == 0) {
            keep(i, point - out * (0.5f * gap), valid);
            room.gap[i] = gap;
        }
    }
    SYNC;
    return found;
}

CUDA_CALLABLE bool side_on_cap(const Cylinders& c, V n, V& normal) {
    if (fabsf(c.axis.z) >= SQUARE) return false;
    float along = n.dot(c.axis);
    V up = {0, 0, 1};
    if (fabsf(along) > 1e-3f) {
        V out = c.axis * -sign(along), start = across(n, up).unit() * c.r1 - up * c.h1;
        normal = -out;
        return line_on_cap(start, up * (2.0f * c.h1), c.apart + out * c.h2, out, c.r2);
    }
    if (fabsf(n.z) <= 1e-3f) return false;
    V out = up * sign(n.z), start = c.apart - across(n, c.axis).unit() * c.r2 - c.axis * c.h2;
    normal = out;
    return line_on_cap(start, c.axis * (2.0f * c.h2), out * c.h1, out, c.r1);
}

CUDA_CALLABLE int cap_on_cap(const Cylinders& c, int p, V n, const Body& frame) {
    float along = n.dot(c.axis), up = sign(n.z);
    V out = c.axis * -sign(along);
    if (!(up * out.z < -ALIGNED && fabsf(n.z) > SQUARE && fabsf(along) > SQUARE)) return 0;
    V cap = c.apart + out * c.h2;
    float slope = fabsf(out.z) > 0.5f ? out.z : 1.0f;
    float gap = sqrtf(most(cap.x * cap.x + cap.y * cap.y, 1e-12f)), x = cap.x / gap, y = cap.y / gap;
    float far = (gap * gap + c.r1 * c.r1 - c.r2 * c.r2) / (2.0f * gap), square = c.r1 * c.r1 - far * far;
    float high = sqrtf(most(square, 1e-12f));
    SYNC;
    EACH(i, 34) {
        float turned = (i % 16) * 0.39269908f, cosine = cosf(turned), sine = sinf(turned);
        if (i < 16) {
            V point = cap + c.turn.axis(0) * (c.r2 * cosine) + c.turn.axis(1) * (c.r2 * sine);
            keep(i, point, point.x * point.x + point.y * point.y <= c.r1 * c.r1);
            continue;
        }
        float side = i == 32 ? high : -high;
        float px = i < 32 ? c.r1 * cosine : far * x - side * y, py = i < 32 ? c.r1 * sine : far * y + side * x;
        float dx = px - cap.x, dy = py - cap.y;
        bool valid = i < 32 ? dx * dx + dy * dy <= c.r2 * c.r2 : square > 0.0f;
        keep(i, {px, py, cap.z - (dx * out.x + dy * out.y) / slope}, valid);
    }
    return feet(p, 34, up, c.h1, out, frame);
}

CUDA_CALLABLE void cylinder_cylinder(int p, const Body& a, const Body& b) {
    Cylinders c = {a.size[0], a.size[1], b.size[0], b.size[1], a.turn.between(b.turn), a.turn.in(b.at() - a.at()), {}};
    c.axis = c.turn.axis(2);
    int kind = 0;
    float depth;
    V n = direction(c, kind, depth), normal;
    if (depth <= 0.0f || cap_on_cap(c, p, n, a)) return;
    if (side_on_cap(c, n, normal)) {
        EACH(i, 2) if (room.valid[i])
            touch(p, i, room.gap[i], a.at() + a.turn.out(load(room.point[i])), a.turn.out(normal));
        return;
    }
    if (lane == 0) touch(p, 0, -depth, a.at() + a.turn.out(single(c, n, kind, depth)), a.turn.out(n));
}

// The other box's facing side, cut to the reference box's face: what lies below it. s: the reference's half sizes with the
// face's normal last, t: the other's axes in that frame, m: its centre. Points 0 to 11 relative to the face.
CUDA_CALLABLE void clip_face(V s, const Turn& t, V m, V other) {
    int b = 0;
    for (int k = 1; k < 3; k++)
        if (fabsf(t.m[6 + k]) > fabsf(t.m[6 + b])) b = k;
    V middle = m + t.axis(b) * ((t.m[6 + b] > 0.0f ? -1.0f : 1.0f) * other.at(b)) - V{0, 0, s.z};
    V u = t.axis((b + 1) % 3) * other.at((b + 1) % 3), v = t.axis((b + 2) % 3) * other.at((b + 2) % 3);
    SYNC;
    EACH(i, 4) {
        V start = middle + u * (i == 0 || i == 3 ? 1.0f : -1.0f) + v * (i < 2 ? 1.0f : -1.0f);
        int e = (i + 1) % 4;
        V way = middle + u * (e == 0 || e == 3 ? 1.0f : -1.0f) + v * (e < 2 ? 1.0f : -1.0f) - start;
        float enter = 0.0f, leave = 1e30f;
        cut(way.x, s.x - start.x, enter, leave);
        cut(-way.x, s.x + start.x, enter, leave);
        cut(way.y, s.y - start.y, enter, leave);
        cut(-way.y, s.y + start.y, enter, leave);
        bool inside = enter <= leave && enter <= 1.0f;
        V first = start + way * clip(enter, 0.0f, 1.0f), last = start + way * clip(leave, 0.0f, 1.0f);
        keep(i, first, inside && first.z <= 0.0f);
        keep(4 + i, last, inside && leave < 1.0f && leave > enter && last.z <= 0.0f);
        float area = u.x * v.y - u.y * v.x;
        if (fabsf(area) < 1e-12f) area = 1e-12f;
        float x = (i == 0 || i == 3 ? s.x : -s.x), y = (i < 2 ? s.y : -s.y), ox = x - middle.x, oy = y - middle.y;
        float on_u = (ox * v.y - oy * v.x) / area, on_v = (oy * u.x - ox * u.y) / area;
        float height = middle.z + on_u * u.z + on_v * v.z;
        keep(8 + i, {x, y, height}, fabsf(on_u) < 1.0f && fabsf(on_v) < 1.0f && height <= 0.0f);
    }
    SYNC;
}

CUDA_CALLABLE void box_box(int p, const Body& a, const Body& b) {
    Turn turn = a.turn.between(b.turn);
    V one = load(a.size), two = load(b.size), apart = a.turn.in(b.at() - a.at()), back = turn.in(apart);
    float face_gap = -1e30f, edge_gap = -1e30f;
    int face = 0, edge = -1;
    for (int k = 0; k < 3; k++) {
        V r = turn.row(k), c = turn.axis(k);
        float first = fabsf(apart.at(k)) - one.at(k) - fabsf(r.x) * two.x - fabsf(r.y) * two.y - fabsf(r.z) * two.z;
        float second = fabsf(back.at(k)) - two.at(k) - fabsf(c.x) * one.x - fabsf(c.y) * one.y - fabsf(c.z) * one.z;
        if (first > face_gap) {
            face_gap = first;
            face = k;
        }
        if (second > face_gap) {
            face_gap = second;
            face = 3 + k;
        }
    }
    V axis = {1, 0, 0};
    for (int e = 0; e < 9; e++) {
        V own = {e < 3 ? 1.0f : 0.0f, e / 3 == 1 ? 1.0f : 0.0f, e >= 6 ? 1.0f : 0.0f}, c = own.cross(turn.axis(e % 3));
        if (c.square() < 1e-7f) continue;
        c = c.unit();
        V o = turn.in(c);
        float gap = fabsf(c.dot(apart)) - fabsf(c.x) * one.x - fabsf(c.y) * one.y - fabsf(c.z) * one.z -
                    fabsf(o.x) * two.x - fabsf(o.y) * two.y - fabsf(o.z) * two.z;
        if (gap > edge_gap) {
            edge_gap = gap;
            edge = e;
            axis = c;
        }
    }
    if (face_gap >= 0.0f || edge_gap >= 0.0f) return;
    bool by_edge = edge >= 0 && edge_gap - 1e-6f * fabsf(edge_gap) > face_gap;
    V facing = face < 3 ? V{face == 0 ? 1.0f : 0.0f, face == 1 ? 1.0f : 0.0f, face == 2 ? 1.0f : 0.0f} : turn.axis(face - 3);
    if (fabsf(axis.dot(facing)) > 0.99f && edge_gap < face_gap + 0.05f * fabsf(face_gap)) by_edge = false;
    if (by_edge) {
        edges(p, a, one, two, turn, apart, edge / 3, edge % 3, axis);
        return;
    }
    // The reference box's frame, the face's normal last and towards the other box.
    bool of_first = face < 3;
    int k = face % 3, order[3] = {(k + 1) % 3, (k + 2) % 3, k};
    V size = of_first ? one : two, other = of_first ? two : one, m = of_first ? apart : -back;
    float flip = sign(m.at(k));
    Turn t;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            float entry = of_first ? turn.m[3 * order[i] + j] : turn.m[3 * j + order[i]];
            t.m[3 * i + j] = i == 2 ? flip * entry : entry;
        }
    clip_face({size.at(order[0]), size.at(order[1]), size.at(k)}, t,
              {m.at(order[0]), m.at(order[1]), flip * m.at(k)}, other);
    const Body& reference = of_first ? a : b;
    V normal = reference.turn.axis(k) * flip;
    if (lane == 0) {
        int n = 0;
        for (int i = 0; i < 12 && n < 8; i++) {
            if (!room.valid[i]) continue;
            V q = load(room.point[i]);
            V place = reference.turn.axis(order[0]) * q.x + reference.turn.axis(order[1]) * q.y +
                      normal * (size.at(k) + 0.5f * q.z);
            touch(p, n++, q.z, reference.at() + place, of_first ? normal : -normal);
        }
    }
}

CUDA_CALLABLE void edges(int p, const Body& a, V one, V two, const Turn& turn, V apart, int i, int j, V axis) {
    if (axis.dot(apart) < 0.0f) axis = -axis;
    V own = {i == 0 ? 1.0f : 0.0f, i == 1 ? 1.0f : 0.0f, i == 2 ? 1.0f : 0.0f}, its = turn.axis(j), o = turn.in(axis);
    V first = {i == 0 ? 0.0f : sign(axis.x) * one.x, i == 1 ? 0.0f : sign(axis.y) * one.y, i == 2 ? 0.0f : sign(axis.z) * one.z};
    V second = {j == 0 ? 0.0f : -sign(o.x) * two.x, j == 1 ? 0.0f : -sign(o.y) * two.y, j == 2 ? 0.0f : -sign(o.z) * two.z};
    second = turn.out(second) + apart;
    V from, to;
    nearest(first, own, one.at(i), second, its, two.at(j), from, to);
    if (lane == 0) touch(p, 0, (to - from).dot(axis), a.at() + a.turn.out((from + to) * 0.5f), a.turn.out(axis));
}
