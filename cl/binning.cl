/* Which splats touch which tile: a stable counting sort without atomics. Chunks of splats are counted per
   tile, the counts are summed up, then every chunk writes its entries; the order in a list is the order of
   the splats, so sums over a list always run the same way. */

__kernel void bin_count(
    __global const int *extents, /* (6, stride): lo and hi along x, y, z; empty when hi < lo */
    const int stride, const int count, const int chunk, const int chunks,
    const int4 tile,             /* tile size along x, y, z */
    const int4 tiles,            /* number of tiles along x, y, z */
    __global int *counts)        /* (tiles, chunks) */
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

/* per tile: counts become positions within the tile, totals go to starts[tile + 1] */
__kernel void bin_within(const int total, const int chunks, __global int *counts, __global int *starts)
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
    starts[t + 1] = sum;
}

/* stays at the largest int where there are more entries than it counts: the host looks, later */
__kernel void bin_starts(const int total, __global int *starts)
{
    if (get_global_id(0) > 0)
        return;
    starts[0] = 0;
    long sum = 0;
    for (int t = 0; t < total; ++t) {
        sum = min(sum + starts[t + 1], (long)INT_MAX);
        starts[t + 1] = (int)sum;
    }
}

__kernel void bin_fill(
    __global const int *extents,
    const int stride, const int count, const int chunk, const int chunks,
    const int4 tile, const int4 tiles,
    __global int *counts, __global const int *starts,
    __global int *entries, const int capacity)
{
    const int k = (int)get_global_id(0);
    if (k >= chunks)
        return;
    const int stop = min(count, (k + 1) * chunk);
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
                    const int position = starts[t] + counts[(size_t)t * chunks + k]++;
                    if (position < capacity)
                        entries[position] = g;
                }
    }
}
