/* The list of Gaussians of a tile, as binning.cl makes it: entries[starts[tile]] to entries[starts[tile + 1] - 1]. */
#define FOR_ENTRIES(e, starts, tile) for (int e = (starts)[tile]; e < (starts)[(tile) + 1]; ++e)

/* Every splat of a tile from every cell that serves its lines: `at` is its place in records (stride, C) and seen (stride, C). */
#define FOR_SPLATS(at, c, starts, entries, tile, cell_count, c_first, c_stop, seen)                                   \
    FOR_ENTRIES(e_, starts, tile)                                                                                     \
        for (int c = (c_first); c < (c_stop); ++c)                                                                    \
            for (size_t at = (size_t)(entries)[e_] * (cell_count) + c, once_ = 1; once_ && (seen)[at]; once_ = 0)
