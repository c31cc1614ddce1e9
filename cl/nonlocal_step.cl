/* A step down the quadratic ½ Σ w_ij (x_i − x_j)² over the voxels of 5³ neighbourhoods. The weights measure how similar
   the 3³ patches about i and j of another volume are, the guide (Buades, Coll and Morel 2005; Gilboa and Osher 2007).

   Likeness exp(−d/h²), d the mean square between patches, is kept in bytes (62, nz, ny, pitch), for one of each pair of
   neighbours i and i + o, at i: w_ij = likeness · min(1/S_i, 1/S_j), S the sums over all neighbours. So weights are symmetric,
   none of their sums is above 1, and a step of at most 1 gives means. Floats are (nz + 6, ny + 6, pitch) with a guard, so that
   a patch about a neighbour lies in them. A work-item takes a row, in vectors, or a voxel. Twin: objective/nonlocal_step.py. */
#include "common/lanes.h"

#define REACH 2 /* of neighbours */
#define SIDE (2 * REACH + 1)
#define HALO (REACH + 1) /* and of the patches about them */
#define PAIRS 62 /* of 124 neighbours, one of each pair o, −o: those that come after the voxel itself */
#define LARGEST 255.0f /* of a byte */

#if BLOCK_PIXEL
#define FOR_X(x, width) const int x = (int)get_global_id(0); if (x < width)
#else
#define FOR_X(x, width) for (int x = 0; x < width; x += LANES)
#endif
#if LANES == 1
#define V_BYTE(v) convert_uchar(v)
#else
#define V_BYTE(v) LANE_TYPE(convert_uchar, LANES)(v)
#endif

/* The neighbour x y z of a pair. */
static inline int4 offset_of(const int pair)
{
    const int n = PAIRS + 1 + pair;
    return (int4)(n % SIDE - REACH, n / SIDE % SIDE - REACH, n / (SIDE * SIDE) - REACH, 0);
}

/* Where voxel 0 of a row lies among floats, and among bytes, in which only neighbours in the volume have a row. */
static inline size_t row_of(const int4 shape, const int pitch, const int y, const int z)
{
    return IMAGE_GUARD + ((size_t)(z + HALO) * (shape.y + 2 * HALO) + y + HALO) * pitch;
}

static inline size_t bytes_of(const int4 shape, const int pitch, const int pair, const int y, const int z)
{
    return IMAGE_GUARD + (((size_t)pair * shape.z + z) * shape.y + y) * pitch;
}

static inline int has_row(const int4 shape, const int y, const int z)
{
    return y >= 0 && y < shape.y && z >= 0 && z < shape.z;
}

/* Plain (nz, ny, nx) to the padded layout, the outermost voxels repeated around it. */
__kernel void nonlocal_start(__global const float *volume, const int4 shape, const int pitch, __global float *padded)
{
    const int x = (int)get_global_id(0) - HALO, y = (int)get_global_id(1) - HALO, z = (int)get_global_id(2) - HALO;
    if (x >= shape.x + HALO)
        return;
    const int4 at = clamp((int4)(x, y, z, 0), (int4)(0), shape - 1);
    padded[row_of(shape, pitch, y, z) + x] = volume[((size_t)at.z * shape.y + at.y) * shape.x + at.x];
}

__kernel void nonlocal_likeness(
    __global const float *guide, const int4 shape, const int pitch,
    const float slope, /* −1/(27 h²) */
    __global uchar *likeness)
{
    const int y = (int)get_global_id(1), z = (int)get_global_id(2);
    const size_t row = row_of(shape, pitch, y, z), slice = (size_t)(shape.y + 2 * HALO) * pitch;
    for (int pair = 0; pair < PAIRS; pair++) {
        const int4 offset = offset_of(pair);
        if (!has_row(shape, y + offset.y, z + offset.z))
            continue;
        const size_t there = row_of(shape, pitch, y + offset.y, z + offset.z) + offset.x;
        FOR_X(x, shape.x)
        {
            vf squares = (vf)(0.0f);
            for (int n = 0; n < 27; n++) {
                const size_t at = (n / 9) * slice + (size_t)(n / 3 % 3) * pitch + n % 3 + x - (slice + pitch + 1);
                const vf difference = V_LOAD(guide + there + at) - V_LOAD(guide + row + at);
                squares += difference * difference;
            }
            const vf column = (vf)(x) + V_IOTA, other = column + (float)offset.x;
            const vf alike = V_PICK(
                0.0f, LARGEST * exp(slope * squares), (other >= 0.0f) & (fmax(column, other) < (float)shape.x));
            VI_STORE(V_BYTE(alike + 0.5f), likeness + bytes_of(shape, pitch, pair, y, z) + x);
        }
    }
}

/* 1/S where there is a neighbour, in units of a byte; the halo of ``share`` stays 0. */
__kernel void nonlocal_share(
    __global const uchar *likeness, const int4 shape, const int pitch, __global float *share)
{
    const int y = (int)get_global_id(1), z = (int)get_global_id(2);
    FOR_X(x, shape.x)
    {
        vf sum = (vf)(0.0f);
        for (int pair = 0; pair < PAIRS; pair++) {
            const int4 offset = offset_of(pair);
            sum += V_FLOAT(VI_LOAD(likeness + bytes_of(shape, pitch, pair, y, z) + x));
            if (has_row(shape, y - offset.y, z - offset.z))
                sum += V_FLOAT(VI_LOAD(
                    likeness + bytes_of(shape, pitch, pair, y - offset.y, z - offset.z) + x - offset.x));
        }
        V_STORE(V_PICK(0.0f, 1.0f / sum, sum > 0.0f), share + row_of(shape, pitch, y, z) + x);
    }
}

/* What one neighbour pulls at a voxel with. */
static inline vf pull(
    __global const float *volume, __global const float *share, __global const uchar *likeness, const size_t there,
    const vf value, const vf own)
{
    return V_FLOAT(VI_LOAD(likeness)) * fmin(own, V_LOAD(share + there)) * (V_LOAD(volume + there) - value);
}

/* x_i + step Σ w_ij (x_j − x_i), plain. */
__kernel void nonlocal_step(
    __global const float *volume, __global const float *share, __global const uchar *likeness, const int4 shape,
    const int pitch, const float step, __global float *result)
{
    const int y = (int)get_global_id(1), z = (int)get_global_id(2);
    const size_t row = row_of(shape, pitch, y, z);
    result += ((size_t)z * shape.y + y) * shape.x;
    FOR_X(x, shape.x)
    {
        const vf value = V_LOAD(volume + row + x), own = V_LOAD(share + row + x);
        vf sum = (vf)(0.0f);
        for (int pair = 0; pair < PAIRS; pair++) {
            const int4 offset = offset_of(pair);
            if (has_row(shape, y + offset.y, z + offset.z))
                sum += pull(
                    volume, share, likeness + bytes_of(shape, pitch, pair, y, z) + x,
                    row_of(shape, pitch, y + offset.y, z + offset.z) + x + offset.x, value, own);
            if (has_row(shape, y - offset.y, z - offset.z))
                sum += pull(
                    volume, share, likeness + bytes_of(shape, pitch, pair, y - offset.y, z - offset.z) + x - offset.x,
                    row_of(shape, pitch, y - offset.y, z - offset.z) + x - offset.x, value, own);
        }
        const vf moved = value + step * sum;
        const int count = min(LANES, shape.x - x);
        if (count == LANES)
            V_STORE(moved, result + x);
        else
            for (int k = 0; k < count; k++)
                result[x + k] = ((const float *)&moved)[k];
    }
}
