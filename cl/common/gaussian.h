/* Gaussians: their parameters in memory, and their rotation. The rows of a matrix (11, stride) are mean x y z, scale 1 2 3,
   unit quaternion w x y z, density. */
#include "common/lanes.h"

#define ROW_MEAN 0
#define ROW_SCALE 3
#define ROW_QUATERNION 6
#define ROW_DENSITY 10

typedef struct { vf x, y, z; } v3;

static inline v3 v3_make(vf x, vf y, vf z) { v3 r; r.x = x; r.y = y; r.z = z; return r; }
static inline v3 v3_cross(v3 a, v3 b)
{
    return v3_make(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}
static inline vf v3_dot(v3 a, v3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline v3 v3_mul(v3 a, v3 b) { return v3_make(a.x * b.x, a.y * b.y, a.z * b.z); }
static inline v3 v3_add(v3 a, v3 b) { return v3_make(a.x + b.x, a.y + b.y, a.z + b.z); }
static inline v3 v3_scale(v3 a, vf s) { return v3_make(a.x * s, a.y * s, a.z * s); }

/* The columns of the rotation matrix R: the Gaussian's axes in world coordinates. */
typedef struct { v3 a, b, c; } frame3;

static inline frame3 quaternion_frame(vf w, vf x, vf y, vf z)
{
    frame3 f;
    f.a = v3_make(1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y));
    f.b = v3_make(2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x));
    f.c = v3_make(2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y));
    return f;
}
static inline v3 to_local(frame3 f, v3 v) { return v3_make(v3_dot(f.a, v), v3_dot(f.b, v), v3_dot(f.c, v)); }
static inline v3 to_world(frame3 f, v3 v)
{
    return v3_add(v3_add(v3_scale(f.a, v.x), v3_scale(f.b, v.y)), v3_scale(f.c, v.z));
}

/* LANES Gaussians, one per lane. */
typedef struct { v3 mean, scale, inv_scale; vf qw, qx, qy, qz, density; frame3 axes; } gaussian;

static inline gaussian gaussian_load(__global const float *gaussians, const int first, const int stride)
{
    __global const float *row = gaussians + first;
    gaussian g;
    g.mean = v3_make(V_LOAD(row), V_LOAD(row + stride), V_LOAD(row + 2 * stride));
    row += ROW_SCALE * stride;
    g.scale = v3_make(V_LOAD(row), V_LOAD(row + stride), V_LOAD(row + 2 * stride));
    g.inv_scale = v3_make(1.0f / g.scale.x, 1.0f / g.scale.y, 1.0f / g.scale.z);
    row = gaussians + first + ROW_QUATERNION * stride;
    g.qw = V_LOAD(row);
    g.qx = V_LOAD(row + stride);
    g.qy = V_LOAD(row + 2 * stride);
    g.qz = V_LOAD(row + 3 * stride);
    g.axes = quaternion_frame(g.qw, g.qx, g.qy, g.qz);
    g.density = V_LOAD(gaussians + first + ROW_DENSITY * stride);
    return g;
}
