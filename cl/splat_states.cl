/* Moves Gaussians to the states of an object that moves, and takes gradients back. The object has at y what the reference
   has at y + w(y), so a Gaussian at m in the reference is at the y with y + w(y) = m. w is a sum of cubic B-splines in
   space, and 0 beyond their control points. In a state, w is the sum of the fields r times shares[r].
     splat_states       a work-item moves a Gaussian to every state, by Newton steps from where it is in the state before.
     splat_states_back  a work-item adds up a Gaussian's gradients by its place and by G = I + dw/dy in every state.
   Each state of a Gaussian has the STATE_ROWS of common/splat_state.h. Twin: operators/twins/rays.py. */
#define STATE_ROWS 12
#define MOST_STEPS 50
#define CLOSE 2e-5f     /* a step shorter than this, in control spacings, is the last: the next would be about its square */
#define LEAST_DET 0.05f /* det G below which the step is y = m - w(y), since Newton's would be too long */

/* The four B-splines along an axis that act on a point, with two derivatives, for control points from `first` on. */
typedef struct { float value[4], slope[4], bend[4]; int first, start, stop; } splines;

static inline splines splines_at(const float place, const float per_spacing, const int count)
{
    splines b;
    const float at = clamp(place * per_spacing, -4.0f, (float)count + 4.0f), below = floor(at), f = at - below, g = 1.0f - f;
    b.first = convert_int(below) - 1;
    b.start = max(0, -b.first);
    b.stop = min(4, count - b.first);
    b.value[0] = g * g * g / 6.0f;
    b.value[1] = (f * f * (3.0f * f - 6.0f) + 4.0f) / 6.0f;
    b.value[2] = (g * g * (3.0f * g - 6.0f) + 4.0f) / 6.0f;
    b.value[3] = f * f * f / 6.0f;
    b.slope[0] = -0.5f * per_spacing * g * g;
    b.slope[1] = per_spacing * f * (1.5f * f - 2.0f);
    b.slope[2] = -per_spacing * g * (1.5f * g - 2.0f);
    b.slope[3] = 0.5f * per_spacing * f * f;
    b.bend[0] = per_spacing * per_spacing * g;
    b.bend[1] = per_spacing * per_spacing * (3.0f * f - 2.0f);
    b.bend[2] = per_spacing * per_spacing * (3.0f * g - 2.0f);
    b.bend[3] = per_spacing * per_spacing * f;
    return b;
}

#define FIELD                                                                                                        \
    __global const float4 *controls, /* (RANK, nz, ny, nx) of x y z 0 */                                            \
    const int4 counts,               /* control points nx, ny, nz */                                                \
    const float4 origin, const float4 per_spacing,                                                                  \
    __global const float *shares,    /* (S, RANK): the fields' weights in each state */                             \
    const int state_count

static inline float4 control_at(__global const float4 *controls, const size_t points, __global const float *shares,
                                const size_t point)
{
    float4 sum = shares[0] * controls[point];
    for (int r = 1; r < RANK; ++r)
        sum += shares[r] * controls[r * points + point];
    return sum;
}

/* The displacement w at a point, and its derivatives along x, y, z. */
typedef struct { float4 shift, along_x, along_y, along_z; } flow;

static flow flow_at(__global const float4 *controls, const int4 counts, const float4 origin, const float4 per_spacing,
                    __global const float *shares, const float4 point)
{
    const size_t points = (size_t)counts.x * counts.y * counts.z;
    const splines x = splines_at(point.x - origin.x, per_spacing.x, counts.x);
    const splines y = splines_at(point.y - origin.y, per_spacing.y, counts.y);
    const splines z = splines_at(point.z - origin.z, per_spacing.z, counts.z);
    flow f;
    f.shift = f.along_x = f.along_y = f.along_z = (float4)(0.0f);
    for (int k = z.start; k < z.stop; ++k)
        for (int j = y.start; j < y.stop; ++j) {
            const size_t row = ((size_t)(z.first + k) * counts.y + (y.first + j)) * counts.x;
            float4 value = (float4)(0.0f), slope = (float4)(0.0f);
            for (int i = x.start; i < x.stop; ++i) {
                const float4 control = control_at(controls, points, shares, row + (x.first + i));
                value += x.value[i] * control;
                slope += x.slope[i] * control;
            }
            f.shift += z.value[k] * y.value[j] * value;
            f.along_x += z.value[k] * y.value[j] * slope;
            f.along_y += z.value[k] * y.slope[j] * value;
            f.along_z += z.slope[k] * y.value[j] * value;
        }
    return f;
}

/* Returns the derivative by `point` of sum_ij by_pull[i][j] dw_i/dy_j. */
static float4 by_curvature(__global const float4 *controls, const int4 counts, const float4 origin, const float4 per_spacing,
                           __global const float *shares, const float4 point, const float4 by_pull[3])
{
    const size_t points = (size_t)counts.x * counts.y * counts.z;
    const splines x = splines_at(point.x - origin.x, per_spacing.x, counts.x);
    const splines y = splines_at(point.y - origin.y, per_spacing.y, counts.y);
    const splines z = splines_at(point.z - origin.z, per_spacing.z, counts.z);
    float4 sum = (float4)(0.0f);
    for (int k = z.start; k < z.stop; ++k)
        for (int j = y.start; j < y.stop; ++j) {
            const size_t row = ((size_t)(z.first + k) * counts.y + (y.first + j)) * counts.x;
            float4 value = (float4)(0.0f), slope = (float4)(0.0f), bend = (float4)(0.0f);
            for (int i = x.start; i < x.stop; ++i) {
                const float4 control = control_at(controls, points, shares, row + (x.first + i));
                const float4 by_slope = control.x * by_pull[0] + control.y * by_pull[1] + control.z * by_pull[2];
                value += x.value[i] * by_slope;
                slope += x.slope[i] * by_slope;
                bend += x.bend[i] * by_slope;
            }
            sum.x += z.value[k] * (y.value[j] * bend.x + y.slope[j] * slope.y) + z.slope[k] * y.value[j] * slope.z;
            sum.y += z.value[k] * (y.slope[j] * slope.x + y.bend[j] * value.y) + z.slope[k] * y.slope[j] * value.z;
            sum.z += z.slope[k] * (y.value[j] * slope.x + y.slope[j] * value.y) + z.bend[k] * y.value[j] * value.z;
        }
    return sum;
}

__kernel void splat_states(
    __global const float *gaussians, /* (11, stride): the reference */
    const int stride,
    FIELD,
    __global float *states)          /* (S, STATE_ROWS, stride): centre x y z, rows of G */
{
    const int g = (int)get_global_id(0);
    if (g >= stride)
        return;
    const float4 mean = (float4)(gaussians[g], gaussians[stride + g], gaussians[2 * stride + g], 0.0f);
    float4 place = mean;
    for (int s = 0; s < state_count; ++s) {
        flow f;
        for (int step = 0; step < MOST_STEPS; ++step) {
            f = flow_at(controls, counts, origin, per_spacing, shares + s * RANK, place);
            const float4 off = place + f.shift - mean;
            const float4 a = f.along_x + (float4)(1, 0, 0, 0), b = f.along_y + (float4)(0, 1, 0, 0);
            const float4 c = f.along_z + (float4)(0, 0, 1, 0); /* a, b, c: columns of G */
            const float det = dot(a, cross(b, c));
            float4 move = off;
            if (det > LEAST_DET)
                move = (float4)(dot(off, cross(b, c)), dot(a, cross(off, c)), dot(a, cross(b, off)), 0.0f) / det;
            const float4 spacings = fabs(move * per_spacing);
            const float furthest = max(spacings.x, max(spacings.y, spacings.z));
            place -= move / max(furthest, 1.0f); /* moves by at most one control spacing */
            if (furthest <= CLOSE)
                break;
        }
        __global float *rows = states + (size_t)s * STATE_ROWS * stride + g;
        const size_t row = stride;
        rows[0] = place.x;
        rows[row] = place.y;
        rows[2 * row] = place.z;
        rows[3 * row] = 1.0f + f.along_x.x;
        rows[4 * row] = f.along_y.x;
        rows[5 * row] = f.along_z.x;
        rows[6 * row] = f.along_x.y;
        rows[7 * row] = 1.0f + f.along_y.y;
        rows[8 * row] = f.along_z.y;
        rows[9 * row] = f.along_x.z;
        rows[10 * row] = f.along_y.z;
        rows[11 * row] = 1.0f + f.along_z.z;
    }
}

static inline float4 vector_of(__global const float *rows, const int row, const size_t stride)
{
    return (float4)(rows[row * stride], rows[(row + 1) * stride], rows[(row + 2) * stride], 0.0f);
}

__kernel void splat_states_back(
    __global const float *states, const int stride, FIELD,
    __global const float *by_states, /* (S, STATE_ROWS, stride): dL/d(places) and dL/dG */
    __global float *gradients)       /* (13, stride), in which the rows of the mean are replaced */
{
    const int g = (int)get_global_id(0);
    if (g >= stride)
        return;
    float4 by_mean = (float4)(0.0f);
    for (int s = 0; s < state_count; ++s) {
        const size_t at = (size_t)s * STATE_ROWS * stride + g;
        float4 pull[3], by_pull[3];
        for (int i = 0; i < 3; ++i) {
            pull[i] = vector_of(states + at, 3 + 3 * i, stride);
            by_pull[i] = vector_of(by_states + at, 3 + 3 * i, stride);
        }
        const float4 place = vector_of(states + at, 0, stride);
        float4 by_place = vector_of(by_states + at, 0, stride);
        if (any((by_pull[0] != 0.0f) | (by_pull[1] != 0.0f) | (by_pull[2] != 0.0f))) /* ends of a segment have no dL/dG */
            by_place += by_curvature(controls, counts, origin, per_spacing, shares + s * RANK, place, by_pull);
        /* dy/dm = 1/G; its transpose has the rows of G's cofactors. */
        const float4 x = cross(pull[1], pull[2]), y = cross(pull[2], pull[0]), z = cross(pull[0], pull[1]);
        by_mean += (float4)(dot(x, by_place), dot(y, by_place), dot(z, by_place), 0.0f) / dot(pull[0], x);
    }
    gradients[g] = by_mean.x;
    gradients[stride + g] = by_mean.y;
    gradients[2 * stride + g] = by_mean.z;
}
