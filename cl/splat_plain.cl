/* Converts parameters of Gaussians as users give them (11, count), in mm, quaternions 1e-12 to 1e12 long, to the rows
   that kernels need (11, stride), with unit quaternions, and gradients back. Twins: tests/operators/test_splat_plain.py. */

#define ROWS 11
#define LENGTHS 6  /* rows that are lengths: mean and scale */
#define QUATERNION 6
#define DENSITY 10

static inline float unit_of(const int row, const float per_mm, const float per_density)
{
    return row < LENGTHS ? per_mm : row == DENSITY ? per_density : 1.0f;
}

/* Writes kernels' rows from users' rows. Columns from `count` on become unit Gaussians, which are never drawn. */
__kernel void rows_enter(
    __global const float *plain,  /* (11, count): a column is a Gaussian */
    const int count, const int stride,
    const float per_mm,           /* 1 mm in internal units of length */
    const float per_density,      /* 1/mm in internal units of density */
    __global float *rows,         /* (11, stride): as in common/gaussian.h */
    __global float *norms)        /* (stride): lengths of the quaternions */
{
    const int g = (int)get_global_id(0);
    if (g >= stride)
        return;
    float value[ROWS] = {0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 1};
    float norm = 1.0f;
    if (g < count) {
        for (int r = 0; r < ROWS; ++r)
            value[r] = plain[(size_t)r * count + g] * unit_of(r, per_mm, per_density);
        __private const float *q = value + QUATERNION;
        norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int r = QUATERNION; r < QUATERNION + 4; ++r)
            value[r] /= norm;
    }
    for (int r = 0; r < ROWS; ++r)
        rows[(size_t)r * stride + g] = value[r];
    norms[g] = norm;
}

/* Writes dL/d(users' rows) from dL/d(kernels' rows), or adds it to the values there if `add`. */
__kernel void rows_leave(
    __global const float *gradients, /* (13, stride): dL/d(the 11 parameters), dL/d(centre u, v) */
    __global const float *norms,
    const int count, const int stride, const float per_mm, const float per_density, const int add,
    __global float *plain)           /* (11, count): a column is a Gaussian */
{
    const int g = (int)get_global_id(0);
    if (g >= count)
        return;
    for (int r = 0; r < ROWS; ++r) {
        const float turned = r >= QUATERNION && r < DENSITY ? norms[g] : 1.0f;
        const float value = unit_of(r, per_mm, per_density) * gradients[(size_t)r * stride + g] / turned;
        const size_t at = (size_t)r * count + g;
        plain[at] = add ? plain[at] + value : value;
    }
}

/* Copies `count` floats, multiplied by a factor. */
__kernel void row_copy(__global const float *from, const long from_start, const int count, const float factor,
                       const long to_start, __global float *to)
{
    const int g = (int)get_global_id(0);
    if (g < count)
        to[to_start + g] = factor * from[from_start + g];
}
