/* The Gaussians of a tile in their order: the list that binning.cl made, entries[starts[tile]] to
   entries[starts[tile + 1] - 1], or all `count` of them where the lists outgrew `capacity`, which is slow and gives the same. */
#define FOR_LISTED(g, starts, entries, tile, capacity, count)                                                         \
    for (int fits_ = (starts)[(tile) + 1] <= (capacity), e_ = fits_ ? (starts)[tile] : 0,                             \
             stop_ = fits_ ? (starts)[(tile) + 1] : (count), g = 0;                                                   \
         e_ < stop_ && (g = fits_ ? (entries)[e_] : e_, 1); ++e_)

/* Every splat of a tile from every cell that serves its lines: `at` is its place in records (stride, C) and seen (stride, C). */
#define FOR_SPLATS(at, c, starts, entries, tile, capacity, count, cell_count, c_first, c_stop, seen)                  \
    FOR_LISTED(g_, starts, entries, tile, capacity, count)                                                            \
        for (int c = (c_first); c < (c_stop); ++c)                                                                    \
            for (size_t at = (size_t)g_ * (cell_count) + c, once_ = 1; once_ && (seen)[at]; once_ = 0)
