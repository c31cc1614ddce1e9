/* Gradients (13, stride): dL/d(the 11 parameters), then dL/d(centre on the detector) (u, v), which density control needs.
   The gradient by rotation is first computed as a torque, dL/d(small rotation about the Gaussian's own axes). It is stored
   as a gradient by the unit quaternion, 2 q (0, torque). */
#include "common/gaussian.h"

#define ROW_STATISTIC 11 /* first of the two rows dL/d(centre on the detector) */
#define ROUND 4e-6f      /* scales s2 and s3 may differ by rounding only if |s3 - s2| / (s3 + s2) is below this */

/* The factor s3 / s2 - s2 / s3 in the torque about an axis across scales s2 and s3. It is set to 0 if the scales differ by
   rounding only: the torque would be a rounding error, of which Adam would make a step of full length. */
static inline vf out_of_round(const vf s2, const vf s3, const vf inv2, const vf inv3)
{
    const vf more = s3 - s2, both = s3 + s2;
    return V_PICK(0.0f, more * both * (inv2 * inv3), fabs(more) > ROUND * both);
}

static inline void gradient_store(__global float *out, const int stride, const int add, v3 mean, v3 scale,
                           v3 torque, vf w, vf x, vf y, vf z, vf density)
{
    const vf values[11] = {
        mean.x, mean.y, mean.z, scale.x, scale.y, scale.z,
        2.0f * (-x * torque.x - y * torque.y - z * torque.z),
        2.0f * (w * torque.x + y * torque.z - z * torque.y),
        2.0f * (w * torque.y + z * torque.x - x * torque.z),
        2.0f * (w * torque.z + x * torque.y - y * torque.x),
        density};
    for (int r = 0; r < 11; ++r) {
        __global float *at = out + (size_t)r * stride;
        const vf before = add ? V_LOAD(at) : (vf)(0.0f);
        V_STORE(before + values[r], at);
    }
}

/* Copies `fields` sums of LANES Gaussians, which are `step` floats apart, to `buffer`: one vector per field. */
static inline void gather_sums(__global const float *sums, const size_t step, const int fields, __private float *buffer)
{
    for (int lane = 0; lane < LANES; ++lane)
        for (int f = 0; f < fields; ++f)
            buffer[f * LANES + lane] = sums[lane * step + f];
}
