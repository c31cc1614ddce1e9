/* Soft thresholding of the DCTs of all 4³ blocks of a volume, averaged over blocks (Coifman and Donoho 1995).
   A coefficient c is reduced by clamp(c, ±threshold); a block's mean stays. `excess` sums by how much the blocks reduce each
   voxel. A call takes every TURNS-th block, so the result is v − TURNS excess / (number of blocks that cover the voxel).
   Volumes are a guard, then (z, y, pitch).
   A work-item has LANES blocks in registers, one voxel apart along x. The blocks of a launch do not overlap in y and z, nor
   in x if LANES is 1, so no two work-items add to the same voxel. Twin: objective/dct_prox.py. */
#include "common/lanes.h"

#define EDGE 4
#define BLOCK 64
#define COS_1 0.65328148f /* cos(π/8)/√2 */
#define COS_3 0.27059805f /* cos(3π/8)/√2 */

/* Orthonormal DCT-II of four values that are `step` elements apart. */
static inline void forward_4(vf *v, const int step)
{
    const vf outer = v[0] + v[3 * step], inner = v[step] + v[2 * step];
    const vf slope = v[0] - v[3 * step], middle = v[step] - v[2 * step];
    v[0] = 0.5f * (outer + inner);
    v[step] = COS_1 * slope + COS_3 * middle;
    v[2 * step] = 0.5f * (outer - inner);
    v[3 * step] = COS_3 * slope - COS_1 * middle;
}

/* The inverse of forward_4, which is its transpose. */
static inline void inverse_4(vf *v, const int step)
{
    const vf outer = 0.5f * (v[0] + v[2 * step]), inner = 0.5f * (v[0] - v[2 * step]);
    const vf slope = COS_1 * v[step] + COS_3 * v[3 * step], middle = COS_3 * v[step] - COS_1 * v[3 * step];
    v[0] = outer + slope;
    v[step] = inner + middle;
    v[2 * step] = inner - middle;
    v[3 * step] = outer - slope;
}

/* Writes to `block` by how much the voxels of LANES blocks at `corner` are reduced. Unrolled loops keep it in registers. */
static inline void shrunk(__global const float *volume, const size_t corner, const int pitch, const size_t slice,
                          const float threshold, vf *block)
{
    #pragma unroll
    for (int k = 0; k < EDGE; k++)
        #pragma unroll
        for (int j = 0; j < EDGE; j++)
            #pragma unroll
            for (int i = 0; i < EDGE; i++)
                block[(k * EDGE + j) * EDGE + i] = V_LOAD(volume + corner + k * slice + j * pitch + i);
    #pragma unroll
    for (int n = 0; n < BLOCK; n += 4)
        forward_4(block + n, 1);
    #pragma unroll
    for (int n = 0; n < 16; n++)
        forward_4(block + (n / 4) * 16 + n % 4, 4);
    #pragma unroll
    for (int n = 0; n < 16; n++)
        forward_4(block + n, 16);
    block[0] = (vf)(0.0f);
    #pragma unroll
    for (int n = 1; n < BLOCK; n++)
        block[n] = max(min(block[n], (vf)(threshold)), (vf)(-threshold));
    #pragma unroll
    for (int n = 0; n < 16; n++)
        inverse_4(block + n, 16);
    #pragma unroll
    for (int n = 0; n < 16; n++)
        inverse_4(block + (n / 4) * 16 + n % 4, 4);
    #pragma unroll
    for (int n = 0; n < BLOCK; n += 4)
        inverse_4(block + n, 1);
}

__kernel void dct_excess(
    __global const float *volume, const int4 shape, const int pitch,
    const int4 shift,                /* first voxel of the first block, x y z; x only with BLOCK_PIXEL */
    const float threshold, __global float *excess)
{
    const int y = EDGE * (int)get_global_id(1) + shift.y, z = EDGE * (int)get_global_id(2) + shift.z;
    if (y + EDGE > shape.y || z + EDGE > shape.z)
        return;
    const size_t slice = (size_t)shape.y * pitch;
    const size_t row = IMAGE_GUARD + z * slice + (size_t)y * pitch;
    const int last = shape.x - EDGE;
    vf block[BLOCK];
#if BLOCK_PIXEL
    const int x = EDGE * (int)get_global_id(0) + shift.x;
    if (x > last)
        return;
#else
    for (int x = 0; x <= last; x += LANES)
#endif
    {
        shrunk(volume, row + x, pitch, slice, threshold, block);
        const vf inside = V_PICK(0.0f, 1.0f, (vf)(x) + V_IOTA <= (float)last);
        #pragma unroll
        for (int k = 0; k < EDGE; k++)
            #pragma unroll
            for (int j = 0; j < EDGE; j++) {
                __global float *line = excess + row + x + k * slice + j * pitch;
                #pragma unroll
                for (int i = 0; i < EDGE; i++)
                    V_STORE(V_LOAD(line + i) + inside * block[(k * EDGE + j) * EDGE + i], line + i);
            }
    }
}

/* Copies a plain volume (nz, ny, nx) to the padded layout, and sets `excess` to 0. */
__kernel void dct_start(
    __global const float *volume, const int4 shape, const int pitch, __global float *padded, __global float *excess)
{
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), z = (int)get_global_id(2);
    if (x >= shape.x)
        return;
    const size_t row = (size_t)z * shape.y + y;
    padded[IMAGE_GUARD + row * pitch + x] = volume[row * shape.x + x];
    excess[IMAGE_GUARD + row * pitch + x] = 0.0f;
}

/* Writes the resulting volume without padding. A work-item takes LANES voxels of a row. */
__kernel void dct_end(
    __global const float *volume, __global const float *excess, const int4 shape, const int pitch, const int nonnegative,
    __global float *result)
{
    const int x = (int)get_global_id(0) * LANES, y = (int)get_global_id(1), z = (int)get_global_id(2);
    if (x >= shape.x)
        return;
    const size_t row = (size_t)z * shape.y + y, first = row * shape.x + x;
    /* the number of blocks along each axis that cover a voxel */
    const vf at = (float)x + V_IOTA;
    const vf along = min(at, (float)(shape.x - EDGE)) - max(at - (float)(EDGE - 1), 0.0f) + 1.0f;
    const int across = (min(y, shape.y - EDGE) - max(0, y - EDGE + 1) + 1) * (min(z, shape.z - EDGE) - max(0, z - EDGE + 1) + 1);
    const vf mean = TURNS * V_LOAD(excess + IMAGE_GUARD + row * pitch + x) / max(along * (float)across, 1.0f);
    if (x + LANES <= shape.x) {
        const vf value = V_LOAD(volume + first) - mean;
        V_STORE(nonnegative ? max(value, 0.0f) : value, result + first);
    } else
        for (int k = 0; k < shape.x - x; ++k) {
            const float value = volume[first + k] - ((const float *)&mean)[k];
            result[first + k] = nonnegative ? fmax(value, 0.0f) : value;
        }
}
