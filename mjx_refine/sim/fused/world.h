// State of one candidate and the lanes that share it. A part of the body of a structure: see kernel.py.
//
// Everything that lanes exchange lies in Room, in a block's shared memory; SYNC stands between writing and reading.
// Values that all lanes compute from the same numbers are the same in all, so that branches on them never part them.

struct V {
    float x, y, z;
    CUDA_CALLABLE V operator+(V o) const { return {x + o.x, y + o.y, z + o.z}; }
    CUDA_CALLABLE V operator-(V o) const { return {x - o.x, y - o.y, z - o.z}; }
    CUDA_CALLABLE V operator-() const { return {-x, -y, -z}; }
    CUDA_CALLABLE V operator*(float s) const { return {x * s, y * s, z * s}; }
    CUDA_CALLABLE float dot(V o) const { return x * o.x + y * o.y + z * o.z; }
    CUDA_CALLABLE V cross(V o) const { return {y * o.z - z * o.y, z * o.x - x * o.z, x * o.y - y * o.x}; }
    CUDA_CALLABLE float square() const { return x * x + y * y + z * z; }
    CUDA_CALLABLE float at(int k) const { return k == 0 ? x : (k == 1 ? y : z); }
    // As a unit vector; where there is no direction, x.
    CUDA_CALLABLE V unit() const {
        float s = square();
        return s < 1e-16f ? V{1.0f, 0.0f, 0.0f} : *this * (1.0f / sqrtf(s));
    }
};

struct Turn {  // a rotation: columns are axes
    float m[9];
    CUDA_CALLABLE V axis(int k) const { return {m[k], m[3 + k], m[6 + k]}; }
    CUDA_CALLABLE V row(int k) const { return {m[3 * k], m[3 * k + 1], m[3 * k + 2]}; }
    CUDA_CALLABLE V out(V v) const { return {row(0).dot(v), row(1).dot(v), row(2).dot(v)}; }
    CUDA_CALLABLE V in(V v) const { return {axis(0).dot(v), axis(1).dot(v), axis(2).dot(v)}; }
    // This one's inverse times another: the other's axes in this frame.
    CUDA_CALLABLE Turn between(const Turn& o) const {
        Turn t;
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) t.m[3 * i + j] = axis(i).dot(o.axis(j));
        return t;
    }
};

struct Body {
    float size[3], mass, inertia[3], lightness;  // lightness: MuJoCo's invweight0 for translations
    float pos[3], quat[4], vel[6];               // in the world: m/s, rad/s
    Turn turn;
    float spun[9];  // moments of inertia in the world
    CUDA_CALLABLE V at() const { return {pos[0], pos[1], pos[2]}; }
};

struct Surface {  // of a pair, as in the packed input
    float slide, torsion, roll, stiffness, damping, drag;
};

struct Pair {
    int first, second, kind, slot;
};

struct Spot {  // a point where two geoms may touch; no contact where distance >= 0
    float distance, point[3], normal[3];
    int pair;
};

struct Contact {
    float rows[6][12];  // the Jacobian in the cone's coordinates, first body's columns, then second's
    float wanted[6];    // reference acceleration in these coordinates
    float u[6], v[6];   // residual acceleration, and its change along the step
    float along[12];    // the slip's direction times rows 1 to 5
    float mu, stiff;    // stiff: over mu squared, the quadratic zone's
    float bend, pull;   // of the curvature, 0 where there is none
    int first, second, zone;
};

enum { TOP = 0, MIDDLE = 1, BOTTOM = 2 };

struct Room {
    Body body[BODIES];
    Surface surface[PAIRS];
    Pair pair[PAIRS];
    Spot spot[SPOTS];
    Contact contact[CONTACTS];
    float hessian[(DOFS + 1) * (DOFS + 1)];  // the last row holds the right side
    float calm[DOFS], acc[DOFS], last[DOFS], slope[DOFS], step[DOFS];
    float point[40][3], gap[40];
    int valid[40], extreme[8], chosen[8];
    int line[78], column[78];  // of the entries of a triangle
    int count;
};

CUDA_CALLABLE static float least(float a, float b) { return a < b ? a : b; }
CUDA_CALLABLE static float most(float a, float b) { return a > b ? a : b; }
CUDA_CALLABLE static float clip(float a, float low, float high) { return least(most(a, low), high); }
CUDA_CALLABLE static float sign(float a) { return a >= 0.0f ? 1.0f : -1.0f; }
CUDA_CALLABLE static V load(const float* a) { return {a[0], a[1], a[2]}; }
CUDA_CALLABLE static void store(float* a, V v) { a[0] = v.x; a[1] = v.y; a[2] = v.z; }

CUDA_CALLABLE static float total(float value) {
#if defined(__CUDA_ARCH__)
    for (int o = 16; o; o >>= 1) value += __shfl_xor_sync(0xffffffffu, value, o);
#endif
    return value;
}

// The least value of all lanes and its index, the lower one of two.
CUDA_CALLABLE static void least_of_all(float& value, int& index) {
#if defined(__CUDA_ARCH__)
    for (int o = 16; o; o >>= 1) {
        float other = __shfl_xor_sync(0xffffffffu, value, o);
        int its = __shfl_xor_sync(0xffffffffu, index, o);
        if (other < value || (other == value && its < index)) {
            value = other;
            index = its;
        }
    }
#endif
}
