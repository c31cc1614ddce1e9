/* 2^x for x <= 0, with which kernels compute Gaussians. */
#include "common/lanes.h"

#define MINUS_HALF_LOG2E (-0.72134752044f)

/* 2^x for x <= 0, with a relative error of 2e-7. A GPU has an instruction for it. PoCL's exp2 handles more ranges and
   roundings, and would take half of the time of drawing a Gaussian. For x below -126 the result is 2^-126, not 0. */
ALWAYS_INLINE vf falling_exp2(const vf x)
{
#if LANES == 1
    return exp2(x);
#else
    const vf bounded = max(x, -126.0f);
    const vf shifted = bounded + 12582912.0f; /* adding 1.5 * 2^23 leaves the nearest integer in the last bits */
    const vf f = bounded - (shifted - 12582912.0f);
    const vf part = 1.0f + f * (0.693146978f + f * (0.240222421f + f * (0.055507337f
                    + f * (0.009671513f + f * 0.001326474f))));
    return LANE_TYPE(as_float, LANES)(LANE_TYPE(as_int, LANES)(part) + (LANE_TYPE(as_int, LANES)(shifted) << 23));
#endif
}
