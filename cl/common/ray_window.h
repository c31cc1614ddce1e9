/* Finds the pixels whose rays may meet a box of voxels, so that the adjoint need not try every cell and pixel. */
#include "common/ray.h"

typedef struct { vi u_lo, u_hi, v_lo, v_hi; } window_t;

/* Narrows [lo, hi] to the values that (m . p) / depth can have for points p of a box. at: its value in the box's middle. */
RAY_INLINE void window_along(const vf at, const vf mx, const vf my, const vf mz, const vf dx, const vf dy, const vf dz,
                             const float4 half_size, const vf widest, const vi ahead, vi *lo, vi *hi)
{
    const vf reach = (fabs(mx - at * dx) * half_size.x + fabs(my - at * dy) * half_size.y
                      + fabs(mz - at * dz) * half_size.z) * widest + 0.01f;
    const vi from = V_INT(ceil(min(max(at - reach, -1e6f), 1e6f)));
    const vi to = V_INT(floor(min(max(at + reach, -1e6f), 1e6f)));
    *lo = VI_PICK(*lo, max(*lo, from), ahead);
    *hi = VI_PICK(*hi, min(*hi, to), ahead);
}

/* Finds all pixels to which points of a box may be projected, from LANES neighbouring cells, on the lines that each serves.
   The box has its middle at voxel index `at`. others: the pixels of a line. Returns which cells see the box; cells from
   `stop` on do not count. matrix (12, stride): rows give u d, v d and depth d of a voxel. cell_lines (C, 2). */
RAY_INLINE vi window_of(__global const float *matrix, const int stride, __global const int *cell_lines, const int others,
                        const int cell, const int stop, const float4 at, const float4 half_size, window_t *w)
{
#define M(k) V_LOAD(matrix + (size_t)(k) * stride + cell)
    vi first, last;
    for (int lane = 0; lane < LANES; ++lane) {
        LANE(int, first, lane) = cell_lines[2 * (cell + lane)];
        LANE(int, last, lane) = cell_lines[2 * (cell + lane) + 1] - 1;
    }
    w->u_lo = ACROSS ? first : (vi)(0);
    w->u_hi = ACROSS ? last : (vi)(others - 1);
    w->v_lo = ACROSS ? (vi)(0) : first;
    w->v_hi = ACROSS ? (vi)(others - 1) : last;
    const vf dx = M(8), dy = M(9), dz = M(10);
    const vf depth = dx * at.x + dy * at.y + dz * at.z + M(11);
    const vf reach = fabs(dx) * half_size.x + fabs(dy) * half_size.y + fabs(dz) * half_size.z;
    const vi ahead = depth > reach * 1.001f; /* a box cut by the plane through the source has no bound */
    const vf per = 1.0f / V_PICK(1.0f, depth, ahead), widest = 1.0f / V_PICK(1.0f, depth - reach, ahead);
    window_along((M(0) * at.x + M(1) * at.y + M(2) * at.z + M(3)) * per, M(0), M(1), M(2), dx, dy, dz, half_size,
                 widest, ahead, &w->u_lo, &w->u_hi);
    window_along((M(4) * at.x + M(5) * at.y + M(6) * at.z + M(7)) * per, M(4), M(5), M(6), dx, dy, dz, half_size,
                 widest, ahead, &w->v_lo, &w->v_hi);
#undef M
    return (VI_IOTA + cell < stop) & (depth + reach > 0.0f) & (w->u_lo <= w->u_hi) & (w->v_lo <= w->v_hi);
}
