/* Adds `fields` values over the items of a work-group, pair by pair in a fixed order, so that results repeat bit for bit.
   All items must call it. `own`: the item's `fields` values. `tree`: local memory (fields, items). `sums`: receives the
   `fields` sums. */
#include "common/lanes.h"

#define GROUP_ITEM ((int)(get_local_id(1) * get_local_size(0) + get_local_id(0)))
#define GROUP_ITEMS ((int)(get_local_size(0) * get_local_size(1)))

ALWAYS_INLINE void group_sums(__private const float *own, const int fields, __local float *tree, __global float *sums)
{
    const int item = GROUP_ITEM, items = GROUP_ITEMS;
    for (int f = 0; f < fields; ++f)
        tree[f * items + item] = own[f];
    for (int width = items, kept; width > 1; width = kept) {
        kept = (width + 1) / 2;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (item < width - kept)
            for (int f = 0; f < fields; ++f)
                tree[f * items + item] += tree[f * items + item + kept];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int f = item; f < fields; f += items)
        sums[f] = tree[f * items];
}
