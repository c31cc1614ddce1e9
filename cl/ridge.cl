/* The gradient Wᵀ g(W v) of a weakly convex ridge regulariser (Goujon, Neumayer and Unser 2024), and a step down it.

   W is two layers of 3³ correlations: CHANNELS filters of the volume, then FILTERS filters of these channels. Only windows
   inside the volume count: channels have n − 2 elements along an axis, responses n − 4, stored at the first voxel of their
   window. g maps a response t to slope_up clamp(t, ±σ knot_up) − slope_down clamp(t, ±σ knot_down). `table` holds the first
   filters (3, 3, 3, CHANNELS), the second ones as (CHANNELS, 3, 3, 3, FILTERS) and as (3, 3, 3, FILTERS, CHANNELS), then the
   slopes and knots.

   To save memory only RING slices of all channels are kept between kernels: (RING, channels, ny, pitch), slice z at
   z % RING, with zeros after a row. A work-item takes a row on a CPU, a voxel on a GPU. Twin: objective/ridge.py. */
#include "common/lanes.h"

#define CHANNELS 4
#define FILTERS 16
#define TAPS 27 /* coefficients of a filter for one channel, 3^3 */
/* Indices in `table` of the second filters, of these in the other order, and of slopes and knots. */
#define SECOND (TAPS * CHANNELS)
#define SECOND_BACK (SECOND + TAPS * CHANNELS * FILTERS)
#define CURVES (SECOND_BACK + TAPS * CHANNELS * FILTERS)

#define AT_ONCE (LANES == 16 || LANES == 1 ? FILTERS : FILTERS / 2) /* filters whose sums fit in the registers */

#if BLOCK_PIXEL
#define FOR_X(x, width) const int x = (int)get_global_id(0); if (x < width)
#else
#define FOR_X(x, width) for (int x = 0; x < width; x += LANES)
#endif

/* Where a row of a channel begins among the RING slices. */
static inline size_t row_of(const int4 shape, const int pitch, const int channels, const int c, const int y, const int z)
{
    return IMAGE_GUARD + (((size_t)(z % RING) * channels + c) * shape.y + y) * pitch;
}

static inline vf inside(const vf value, const int x, const int width)
{
    return V_PICK(0.0f, value, (vf)(x) + V_IOTA < (float)width);
}

/* Applies the first filters to the padded volume. In all kernels here, work-items along z begin at slice `first`. */
__kernel void ridge_channels(
    __global const float *volume, const int4 shape, const int pitch, const int first, __constant const float *table,
    __global float *channels)
{
    const int y = (int)get_global_id(1), z = first + (int)get_global_id(2);
    const size_t slice = (size_t)shape.y * pitch;
    volume += IMAGE_GUARD + z * slice + (size_t)y * pitch;
    FOR_X(x, shape.x - 2)
    {
        vf sums[CHANNELS];
        #pragma unroll
        for (int c = 0; c < CHANNELS; c++)
            sums[c] = (vf)(0.0f);
        for (int tap = 0; tap < TAPS; tap++) {
            const vf value = V_LOAD(volume + (tap / 9) * slice + (size_t)(tap / 3 % 3) * pitch + tap % 3 + x);
            #pragma unroll
            for (int c = 0; c < CHANNELS; c++)
                sums[c] += table[tap * CHANNELS + c] * value;
        }
        #pragma unroll
        for (int c = 0; c < CHANNELS; c++)
            V_STORE(inside(sums[c], x, shape.x - 2), channels + row_of(shape, pitch, CHANNELS, c, y, z) + x);
    }
}

/* Applies the second filters, and then g. */
__kernel void ridge_responses(
    __global const float *channels, const int4 shape, const int pitch, const int first, __constant const float *table,
    const float sigma, __global float *responses)
{
    const int y = (int)get_global_id(1), z = first + (int)get_global_id(2);
    FOR_X(x, shape.x - 4)
        for (int from = 0; from < FILTERS; from += AT_ONCE) {
            vf sums[AT_ONCE];
            #pragma unroll
            for (int i = 0; i < AT_ONCE; i++)
                sums[i] = (vf)(0.0f);
            #pragma unroll
            for (int c = 0; c < CHANNELS; c++)
                for (int row = 0; row < 9; row++) {
                    __global const float *line = channels + row_of(shape, pitch, CHANNELS, c, y + row % 3, z + row / 3) + x;
                    for (int k = 0; k < 3; k++) {
                        __constant const float *weights = table + SECOND + (c * TAPS + row * 3 + k) * FILTERS + from;
                        const vf value = V_LOAD(line + k);
                        #pragma unroll
                        for (int i = 0; i < AT_ONCE; i++)
                            sums[i] += weights[i] * value;
                    }
                }
            #pragma unroll
            for (int i = 0; i < AT_ONCE; i++) {
                __constant const float *curve = table + CURVES + from + i;
                const vf up = (vf)(sigma * curve[FILTERS]), down = (vf)(sigma * curve[3 * FILTERS]);
                const vf bent = curve[0] * clamp(sums[i], -up, up) - curve[2 * FILTERS] * clamp(sums[i], -down, down);
                V_STORE(inside(bent, x, shape.x - 4), responses + row_of(shape, pitch, FILTERS, from + i, y, z) + x);
            }
        }
}

/* Applies the transpose of the second filters. Each k has its own sums, so that additions need not wait for each other. */
__kernel void ridge_channels_back(
    __global const float *responses, const int4 shape, const int pitch, const int first, __constant const float *table,
    __global float *channels)
{
    const int y = (int)get_global_id(1), z = first + (int)get_global_id(2);
    FOR_X(x, shape.x - 2)
    {
        vf sums[3][CHANNELS];
        #pragma unroll
        for (int n = 0; n < 3 * CHANNELS; n++)
            sums[n / CHANNELS][n % CHANNELS] = (vf)(0.0f);
        for (int row = 0; row < 9; row++) {
            const int from_y = y - row % 3, from_z = z - row / 3;
            if (from_y < 0 || from_y >= shape.y - 4 || from_z < 0 || from_z >= shape.z - 4)
                continue;
            for (int i = 0; i < FILTERS; i++) {
                __global const float *line = responses + row_of(shape, pitch, FILTERS, i, from_y, from_z) + x;
                __constant const float *weights = table + SECOND_BACK + (row * 3 * FILTERS + i) * CHANNELS;
                #pragma unroll
                for (int k = 0; k < 3; k++) {
                    const vf value = V_LOAD(line - k);
                    #pragma unroll
                    for (int c = 0; c < CHANNELS; c++)
                        sums[k][c] += weights[k * FILTERS * CHANNELS + c] * value;
                }
            }
        }
        #pragma unroll
        for (int c = 0; c < CHANNELS; c++) {
            const vf sum = sums[0][c] + sums[1][c] + sums[2][c];
            V_STORE(inside(sum, x, shape.x - 2), channels + row_of(shape, pitch, CHANNELS, c, y, z) + x);
        }
    }
}

/* Applies the transpose of the first filters, which gives the gradient. Writes v − step · gradient without padding. */
__kernel void ridge_step(
    __global const float *volume, __global const float *channels, const int4 shape, const int pitch, const int first,
    __constant const float *table, const float step, const int nonnegative, __global float *result)
{
    const int y = (int)get_global_id(1), z = first + (int)get_global_id(2);
    volume += IMAGE_GUARD + ((size_t)z * shape.y + y) * pitch;
    result += ((size_t)z * shape.y + y) * shape.x;
    FOR_X(x, shape.x)
    {
        vf sums[CHANNELS];
        #pragma unroll
        for (int c = 0; c < CHANNELS; c++)
            sums[c] = (vf)(0.0f);
        for (int row = 0; row < 9; row++) {
            const int from_y = y - row % 3, from_z = z - row / 3;
            if (from_y < 0 || from_y >= shape.y - 2 || from_z < 0 || from_z >= shape.z - 2)
                continue;
            for (int k = 0; k < 3; k++)
                #pragma unroll
                for (int c = 0; c < CHANNELS; c++)
                    sums[c] += table[(row * 3 + k) * CHANNELS + c]
                        * V_LOAD(channels + row_of(shape, pitch, CHANNELS, c, from_y, from_z) + x - k);
        }
        const vf moved = V_LOAD(volume + x) - step * ((sums[0] + sums[1]) + (sums[2] + sums[3]));
        const vf value = nonnegative ? max(moved, (vf)(0.0f)) : moved;
        const int count = min(LANES, shape.x - x);
        if (count == LANES)
            V_STORE(value, result + x);
        else
            for (int k = 0; k < count; k++)
                result[x + k] = ((const float *)&value)[k];
    }
}
