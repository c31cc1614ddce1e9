/* Voxeliser: every tile of voxels sums its list of Gaussians. A work-item owns rows of x (BLOCK_PIXEL 0) or
   one voxel (BLOCK_PIXEL 1, where a work-group runs along x). */
#include "common/tile.h"
#include "common/voxel.h"

__kernel void voxel_forward(
    __global const float *records, __global const int *starts, __global const int *entries,
    const int capacity, const int count,
    const int4 shape, const int pitch, const int4 tile, const int4 tiles, const float cutoff2,
    __global float *volume)          /* guard, then (z, y, pitch) */
{
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
#if BLOCK_PIXEL
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), z = (int)get_global_id(2);
    if (x >= pitch)
        return;
    const size_t at = IMAGE_GUARD + ((size_t)z * shape.y + y) * pitch + x;
    if (x >= shape.x) {
        volume[at] = 0.0f;
        return;
    }
    const int t = ((z / tile.z) * tiles.y + y / tile.y) * tiles.x + x / tile.x;
    float sum = 0.0f;
    FOR_LISTED(g, starts, entries, t, capacity, count) {
        __global const float *rec = records + (size_t)g * VOXEL_RECORD;
        __global const int *whole = (__global const int *)rec;
        if (x < whole[VOX_LO] || x > whole[VOX_HI] || y < whole[VOX_LO + 1] || y > whole[VOX_HI + 1] ||
            z < whole[VOX_LO + 2] || z > whole[VOX_HI + 2])
            continue;
        const voxel_row r = voxel_row_at(rec, y, z);
        sum += voxel_value(r, voxel_dx(r, x), 1.0f, limit);
    }
    volume[at] = sum;
#else
    const int t = (int)get_global_id(0);
    if (t >= tiles.y * tiles.z)
        return;
    const int y_first = (t % tiles.y) * tile.y, y_last = min(y_first + tile.y, shape.y) - 1;
    const int z_first = (t / tiles.y) * tile.z, z_last = min(z_first + tile.z, shape.z) - 1;
    for (int z = z_first; z <= z_last; ++z)
        for (int y = y_first; y <= y_last; ++y)
            for (int x = 0; x < pitch; x += LANES)
                V_STORE((vf)(0.0f), volume + IMAGE_GUARD + ((size_t)z * shape.y + y) * pitch + x);
    FOR_LISTED(g, starts, entries, t, capacity, count) {
        __global const float *rec = records + (size_t)g * VOXEL_RECORD;
        __global const int *whole = (__global const int *)rec;
        const int z_lo = max(z_first, whole[VOX_LO + 2]), z_hi = min(z_last, whole[VOX_HI + 2]);
        const int y_lo = max(y_first, whole[VOX_LO + 1]), y_hi = min(y_last, whole[VOX_HI + 1]);
        const int x_lo = whole[VOX_LO], x_hi = whole[VOX_HI];
        for (int z = z_lo; z <= z_hi; ++z)
            for (int y = y_lo; y <= y_hi; ++y) {
                const voxel_row r = voxel_row_at(rec, y, z);
                if (r.k > limit) /* a corner of the box */
                    continue;
                __global float *row = volume + IMAGE_GUARD + ((size_t)z * shape.y + y) * pitch;
                for (int x = x_lo; x <= x_hi; x += LANES)
                    V_STORE(V_LOAD(row + x) + voxel_value(r, voxel_dx(r, x), (vf)(1.0f), limit), row + x);
            }
    }
    for (int z = z_first; z <= z_last; ++z)
        for (int y = y_first; y <= y_last; ++y)
            for (int x = shape.x; x < pitch; ++x)
                volume[IMAGE_GUARD + ((size_t)z * shape.y + y) * pitch + x] = 0.0f;
#endif
}
