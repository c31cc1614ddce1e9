/* Measures how many multiply-adds on registers the device does per second at best. */
#include "common/lanes.h"

/* Does 16 · LANES · steps floating-point operations per work-item, in 8 independent chains, because a single chain would
   have to wait for each result. */
__kernel void multiply_add(const int steps, const float factor, __global float *out)
{
    const vf a = (vf)(factor), b = (vf)(1.0f - factor);
    vf c0 = (vf)((float)(get_global_id(0) % 7)), c1 = c0 + 1.0f, c2 = c0 + 2.0f, c3 = c0 + 3.0f;
    vf c4 = c0 + 4.0f, c5 = c0 + 5.0f, c6 = c0 + 6.0f, c7 = c0 + 7.0f; /* no array: it would lie in memory */
    for (int step = 0; step < steps; ++step) {
        c0 = mad(c0, a, b);
        c1 = mad(c1, a, b);
        c2 = mad(c2, a, b);
        c3 = mad(c3, a, b);
        c4 = mad(c4, a, b);
        c5 = mad(c5, a, b);
        c6 = mad(c6, a, b);
        c7 = mad(c7, a, b);
    }
    out[get_global_id(0)] = v_sum(((c0 + c1) + (c2 + c3)) + ((c4 + c5) + (c6 + c7)));
}
