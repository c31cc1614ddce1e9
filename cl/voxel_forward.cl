/* Evaluates Gaussians on a voxel grid: every tile of voxels sums its list of Gaussians. BLOCK_PIXEL 0 (CPUs): a work-item
   takes the rows of a tile. BLOCK_PIXEL 1 (GPUs): a work-group takes a tile, and an item voxels along z; records are read
   once for all items. */
#if BLOCK_PIXEL
#define VOXEL_SPACE __local
#endif
#include "common/tile.h"
#include "common/voxel.h"

#define STAGED 32 /* number of records of Gaussians that a work-group reads into local memory at a time */
#define DEPTH 2   /* voxels along z of a work-item; DEPTH in operators/splats/voxelise.py */

__kernel void voxel_forward(
    __global const float *records, __global const int *tile_offsets, __global const int *tile_splat_ids,
    const int capacity, const int count,
    const int4 shape, const int pitch, const int4 tile, const int4 tiles, const float cutoff2,
    __global float *volume)          /* guard, then (z, y, pitch) */
{
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
#if BLOCK_PIXEL
    __local int records_here[STAGED * VOXEL_RECORD]; /* as ints: copied as floats, a device may set small ints to 0 */
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), z_first = (int)get_global_id(2) * DEPTH;
    const int item = (int)((get_local_id(2) * get_local_size(1) + get_local_id(1)) * get_local_size(0) + get_local_id(0));
    const int items = (int)(get_local_size(0) * get_local_size(1) * get_local_size(2));
    const int t = (z_first / tile.z * tiles.y + y / tile.y) * tiles.x + x / tile.x; /* get_group_id restarts in each part of a launch */
    const tile_list list = list_of(tile_offsets, t, capacity, count);
    float sum[DEPTH] = {0.0f};
    for (int done = 0; done < list.count; done += STAGED) {
        const int here = min(STAGED, list.count - done);
        barrier(CLK_LOCAL_MEM_FENCE); /* waits until all items have read the last records */
        for (int f = item; f < here * VOXEL_RECORD; f += items) {
            const int e = done + f / VOXEL_RECORD;
            const size_t splat = (size_t)listed_splat(list, tile_splat_ids, e) * VOXEL_RECORD;
            records_here[f] = ((__global const int *)records)[splat + f % VOXEL_RECORD];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int k = 0; k < here; ++k) {
            __local const int *record_as_int = records_here + k * VOXEL_RECORD;
            __local const float *voxel_record = (__local const float *)record_as_int;
            if (x < record_as_int[VOX_LO] || x > record_as_int[VOX_HI] || y < record_as_int[VOX_LO + 1] || y > record_as_int[VOX_HI + 1])
                continue;
#pragma unroll
            for (int d = 0; d < DEPTH; ++d)
                if (z_first + d >= record_as_int[VOX_LO + 2] && z_first + d <= record_as_int[VOX_HI + 2]) {
                    const voxel_row r = voxel_row_at(voxel_record, y, z_first + d);
                    sum[d] += voxel_value(r, voxel_dx(r, x), 1.0f, limit);
                }
        }
    }
    if (x >= shape.x || y >= shape.y)
        return;
#pragma unroll
    for (int d = 0; d < DEPTH; ++d)
        if (z_first + d < shape.z)
            volume[IMAGE_GUARD + ((size_t)(z_first + d) * shape.y + y) * pitch + x] = sum[d];
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
    const tile_list list = list_of(tile_offsets, t, capacity, count);
    for (int k = 0; k < list.count; ++k) {
        __global const float *voxel_record = records + (size_t)listed_splat(list, tile_splat_ids, k) * VOXEL_RECORD;
        __global const int *record_as_int = (__global const int *)voxel_record;
        const int z_lo = max(z_first, record_as_int[VOX_LO + 2]), z_hi = min(z_last, record_as_int[VOX_HI + 2]);
        const int y_lo = max(y_first, record_as_int[VOX_LO + 1]), y_hi = min(y_last, record_as_int[VOX_HI + 1]);
        const int x_lo = record_as_int[VOX_LO], x_hi = record_as_int[VOX_HI];
        for (int z = z_lo; z <= z_hi; ++z)
            for (int y = y_lo; y <= y_hi; ++y) {
                const voxel_row r = voxel_row_at(voxel_record, y, z);
                if (r.k > limit) /* the row crosses a corner of the bounding box, beyond the cutoff */
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
