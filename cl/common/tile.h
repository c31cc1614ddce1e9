/* The splats of a tile, as binning.cl lists them: the elements of tile_splat_ids from tile_offsets[tile] up to, but without,
   tile_offsets[tile + 1]. If the list did not fit into `capacity`, all splats are taken: slower, with the
   same result. */
#include "common/lanes.h"

typedef struct { int is_written, first, count; } tile_list;

ALWAYS_INLINE tile_list list_of(__global const int *tile_offsets, const int tile, const int capacity, const int splat_count)
{
    tile_list list;
    list.is_written = tile_offsets[tile + 1] <= capacity;
    list.first = list.is_written ? tile_offsets[tile] : 0;
    list.count = list.is_written ? tile_offsets[tile + 1] - list.first : splat_count;
    return list;
}

ALWAYS_INLINE int listed_splat(const tile_list list, __global const int *tile_splat_ids, const int k)
{
    return list.is_written ? tile_splat_ids[list.first + k] : k;
}
