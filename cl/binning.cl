/* Lists the splats in each tile, by a stable counting sort. The splats are divided into chunks. First each chunk counts its
   splats per tile, then the counts are summed to positions, then each chunk writes the indices of its splats to these
   positions. A list keeps the order of the splats, so sums over a list always add in the same order.
   On CPUs a work-item takes a chunk (bin_count, bin_fill) or a tile (bin_within); bin_starts is one work-item.
   On GPUs (_group) a work-group takes a chunk, with a work-item per splat, or a tile; bin_starts_group is one work-group. */
#include "common/group_sums.h"

__kernel void bin_count(
    __global const int *extents, /* (6, stride): lo and hi along x, y, z, in pixels or voxels; empty if hi < lo */
    const int stride, const int count, const int chunk, const int chunks,
    const int4 tile,             /* tile size along x, y, z */
    const int4 tiles,            /* number of tiles along x, y, z */
    __global int *counts)        /* (tiles, chunks): how many splats of a chunk touch a tile */
{
    const int k = (int)get_global_id(0);
    if (k >= chunks)
        return;
    const int total = tiles.x * tiles.y * tiles.z;
    for (int t = 0; t < total; ++t)
        counts[(size_t)t * chunks + k] = 0;
    const int stop = min(count, (k + 1) * chunk);
    for (int g = k * chunk; g < stop; ++g) {
        if (extents[stride + g] < extents[g])
            continue;
        const int x0 = extents[g] / tile.x, x1 = extents[stride + g] / tile.x;
        const int y0 = extents[2 * stride + g] / tile.y, y1 = extents[3 * stride + g] / tile.y;
        const int z0 = extents[4 * stride + g] / tile.z, z1 = extents[5 * stride + g] / tile.z;
        for (int z = z0; z <= z1; ++z)
            for (int y = y0; y <= y1; ++y)
                for (int x = x0; x <= x1; ++x)
                    counts[(size_t)((z * tiles.y + y) * tiles.x + x) * chunks + k] += 1;
    }
}

/* For each tile, replaces the chunks' counts by where each chunk begins in the tile's list. Writes the list's length to
   tile_offsets[tile + 1]. */
__kernel void bin_within(const int total, const int chunks, __global int *counts, __global int *tile_offsets)
{
    const int t = (int)get_global_id(0);
    if (t >= total)
        return;
    int sum = 0;
    for (int k = 0; k < chunks; ++k) {
        const int here = counts[(size_t)t * chunks + k];
        counts[(size_t)t * chunks + k] = sum;
        sum += here;
    }
    tile_offsets[t + 1] = sum;
}

/* Sums the lengths of lists to offsets. Offsets above INT_MAX are set to INT_MAX, and the host raises an error. */
__kernel void bin_starts(const int total, __global int *tile_offsets)
{
    if (get_global_id(0) > 0)
        return;
    tile_offsets[0] = 0;
    long sum = 0;
    for (int t = 0; t < total; ++t) {
        sum = min(sum + tile_offsets[t + 1], (long)INT_MAX);
        tile_offsets[t + 1] = (int)sum;
    }
}

__kernel void bin_fill(
    __global const int *extents,
    const int stride, const int count, const int chunk, const int chunks,
    const int4 tile, const int4 tiles,
    __global int *counts, __global const int *tile_offsets,
    __global int *tile_splat_ids, const int capacity)
{
    const int k = (int)get_global_id(0);
    if (k >= chunks)
        return;
    const int stop = min(count, (k + 1) * chunk); /* loops as in bin_count: a macro for both was 1.2 to 1.4 times slower */
    for (int g = k * chunk; g < stop; ++g) {
        if (extents[stride + g] < extents[g])
            continue;
        const int x0 = extents[g] / tile.x, x1 = extents[stride + g] / tile.x;
        const int y0 = extents[2 * stride + g] / tile.y, y1 = extents[3 * stride + g] / tile.y;
        const int z0 = extents[4 * stride + g] / tile.z, z1 = extents[5 * stride + g] / tile.z;
        for (int z = z0; z <= z1; ++z)
            for (int y = y0; y <= y1; ++y)
                for (int x = x0; x <= x1; ++x) {
                    const int t = (z * tiles.y + y) * tiles.x + x;
                    const int position = tile_offsets[t] + counts[(size_t)t * chunks + k]++;
                    if (position < capacity)
                        tile_splat_ids[position] = g;
                }
    }
}

/* Writes into `boxes` (6, items) the lowest and highest tile of the item's splat along x, y, z; an empty range if the splat
   is not drawn or the item has none. Writes into `around` (6) the range of tiles of all the group's splats. */
ALWAYS_INLINE void share_box(__global const int *extents, const int stride, const int count, const int g, const int4 tile,
                             __local int *boxes, __local int *around)
{
    const int item = GROUP_ITEM, items = GROUP_ITEMS;
    const int size[3] = {tile.x, tile.y, tile.z};
    const int is_drawn = g < count && extents[stride + g] >= extents[g];
    if (item < 6)
        around[item] = item & 1 ? -1 : INT_MAX;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int side = 0; side < 6; ++side) {
        const int at = is_drawn ? extents[(size_t)side * stride + g] / size[side / 2] : -(side & 1);
        boxes[side * items + item] = at;
        if (is_drawn) /* integers: the result does not depend on the order */
            side & 1 ? atomic_max(around + side, at) : atomic_min(around + side, at);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

/* Returns whether the item's splat touches tile (x, y, z). */
ALWAYS_INLINE int touches(__local const int *boxes, const int item, const int x, const int y, const int z)
{
    __local const int *own = boxes + item;
    const int n = GROUP_ITEMS;
    return x >= own[0] && x <= own[n] && y >= own[2 * n] && y <= own[3 * n] && z >= own[4 * n] && z <= own[5 * n];
}

/* The items of a group divide the tiles around all its splats. */
#define FOR_OWN_TILES(around, tiles, x, y, z, t)                                                                           \
    for (int nx_ = around[1] - around[0] + 1, ny_ = around[3] - around[2] + 1, n_ = GROUP_ITEM;                             \
         around[1] >= 0 && n_ < nx_ * ny_ * (around[5] - around[4] + 1); n_ += GROUP_ITEMS)                                 \
        for (int x = around[0] + n_ % nx_, y = around[2] + n_ / nx_ % ny_, z = around[4] + n_ / (nx_ * ny_),                \
                 t = (z * tiles.y + y) * tiles.x + x; t >= 0; t = -1)

__kernel void bin_count_group(
    __global const int *extents,
    const int stride, const int count, const int chunk, const int chunks,
    const int4 tile, const int4 tiles,
    __global int *counts,            /* (tiles, chunks); must be 0 before the launch */
    __local int *boxes)              /* (6, chunk): tiles lo and hi along x, y, z of each splat */
{
    __local int around[6];
    const int k = (int)get_group_id(0);
    share_box(extents, stride, count, k * chunk + GROUP_ITEM, tile, boxes, around);
    FOR_OWN_TILES(around, tiles, x, y, z, t) {
        int sum = 0;
        for (int item = 0; item < chunk; ++item)
            sum += touches(boxes, item, x, y, z);
        counts[(size_t)t * chunks + k] = sum;
    }
}

/* Returns the sum of `own` over the work-items before this one. group_sum: the sum over all. */
ALWAYS_INLINE long group_scan(const long own, __local long *scratch, long *group_sum)
{
    const int item = GROUP_ITEM, items = GROUP_ITEMS;
    scratch[item] = own;
    for (int reach = 1; reach < items; reach *= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        const long before = item >= reach ? scratch[item - reach] : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        scratch[item] += before;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    *group_sum = scratch[items - 1];
    const long sum = scratch[item] - own;
    barrier(CLK_LOCAL_MEM_FENCE);
    return sum;
}

__kernel void bin_within_group(
    const int total, const int chunks, __global int *counts, __global int *tile_offsets, __local long *scratch)
{
    const int t = (int)get_group_id(0);
    if (t >= total)
        return;
    __global int *own = counts + (size_t)t * chunks;
    long sum = 0, group_sum;
    for (int first = 0; first < chunks; first += GROUP_ITEMS) {
        const int k = first + GROUP_ITEM;
        const long before = group_scan(k < chunks ? own[k] : 0, scratch, &group_sum);
        if (k < chunks)
            own[k] = (int)(sum + before);
        sum += group_sum;
    }
    if (GROUP_ITEM == 0)
        tile_offsets[t + 1] = (int)sum;
}

__kernel void bin_starts_group(const int total, __global int *tile_offsets, __local long *scratch)
{
    long sum = 0, group_sum;
    for (int first = 0; first < total; first += GROUP_ITEMS) {
        const int t = first + GROUP_ITEM;
        const long here = t < total ? tile_offsets[t + 1] : 0;
        const long before = group_scan(here, scratch, &group_sum);
        if (t < total)
            tile_offsets[t + 1] = (int)min(sum + before + here, (long)INT_MAX);
        sum += group_sum;
    }
    if (GROUP_ITEM == 0)
        tile_offsets[0] = 0;
}

__kernel void bin_fill_group(
    __global const int *extents,
    const int stride, const int count, const int chunk, const int chunks,
    const int4 tile, const int4 tiles,
    __global const int *counts, __global const int *tile_offsets,
    __global int *tile_splat_ids, const int capacity,
    __local int *boxes)
{
    __local int around[6];
    const int k = (int)get_group_id(0);
    share_box(extents, stride, count, k * chunk + GROUP_ITEM, tile, boxes, around);
    FOR_OWN_TILES(around, tiles, x, y, z, t) {
        int position = tile_offsets[t] + counts[(size_t)t * chunks + k];
        for (int item = 0; item < chunk; ++item)
            if (touches(boxes, item, x, y, z)) {
                if (position < capacity)
                    tile_splat_ids[position] = k * chunk + item;
                ++position;
            }
    }
}
