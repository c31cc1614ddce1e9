/* The rays to one detector column, LANES lines (pixels of the column) at a time, and the table of slots: the buffers for the
   line integrals of one pose each (operators/rays/slots.py).
   LEAN 0: the column is parallel to the volume's z, so all its rays have the same direction in x and y. */
#include "common/ray.h"

#define SLOT 8         /* ints of a slot: its pose, the columns and lines [first, stop) that the pose serves, unused ones */
#define SLOT_CELL 0
#define SLOT_U 1
#define SLOT_U_STOP 2
#define SLOT_V 3
#define SLOT_V_STOP 4

typedef struct { vf x, y, z; } column_rays_t; /* from the source to pixels, in voxels */

/* One component of the ray to a pixel, computed as in rays_through. */
RAY_INLINE float ray_component(__global const float *cell, const int axis, const int u, const int v)
{
    const float line = LEAN || axis == 2 ? fma((float)v, cell[RAY_EV + axis], cell[RAY_D00 + axis]) : cell[RAY_D00 + axis];
    return fma((float)u, cell[RAY_EU + axis], line);
}

RAY_INLINE column_rays_t column_rays(__global const float *cell, const int u, const int v_first)
{
    column_rays_t d;
    const vf v = (float)v_first + V_IOTA, uu = (vf)((float)u);
#if LEAN
    d.x = fma(uu, (vf)(cell[RAY_EU]), fma(v, (vf)(cell[RAY_EV]), (vf)(cell[RAY_D00])));
    d.y = fma(uu, (vf)(cell[RAY_EU + 1]), fma(v, (vf)(cell[RAY_EV + 1]), (vf)(cell[RAY_D00 + 1])));
#else
    d.x = (vf)(ray_component(cell, 0, u, 0));
    d.y = (vf)(ray_component(cell, 1, u, 0));
#endif
    d.z = fma(uu, (vf)(cell[RAY_EU + 2]), fma(v, (vf)(cell[RAY_EV + 2]), (vf)(cell[RAY_D00 + 2])));
    return d;
}

/* Whether the main axis is x, else y. It is never z: such scans take the general kernel. */
RAY_INLINE vi column_along_x(__global const float *cell, const column_rays_t d)
{
#if RAY_PARALLEL
    return (vi)(fabs(cell[RAY_SOURCE]) >= fabs(cell[RAY_SOURCE + 1]));
#else
    return VI_PICK(0, 1, fabs(d.x) >= fabs(d.y));
#endif
}

RAY_INLINE int is_along_x(__global const float *cell, const int u, const int v)
{
#if RAY_PARALLEL
    return fabs(cell[RAY_SOURCE]) >= fabs(cell[RAY_SOURCE + 1]);
#else
    return fabs(ray_component(cell, 0, u, v)) >= fabs(ray_component(cell, 1, u, v));
#endif
}

/* The length of each ray from one plane of voxels to the next, in mm. */
RAY_INLINE vf column_steps_mm(__global const float *cell, column_rays_t d, const float4 pitch_mm)
{
#if RAY_PARALLEL
    d.x = (vf)(cell[RAY_SOURCE]);
    d.y = (vf)(cell[RAY_SOURCE + 1]);
    d.z = (vf)(cell[RAY_SOURCE + 2]);
#endif
    const vf lx = d.x * pitch_mm.x, ly = d.y * pitch_mm.y, lz = d.z * pitch_mm.z;
    return sqrt(lx * lx + ly * ly + lz * lz) / max(fabs(d.x), fabs(d.y));
}

/* The first and last of `count` planes along the main axis that are between source and detector. If LEAN, all are, which
   operators/rays/upright.py ensures. In a parallel beam all count. */
RAY_INLINE int2 planes_between(__global const float *cell, const int u, const int along_x, const int first, const int count)
{
#if LEAN || RAY_PARALLEL
    return (int2)(first, first + count - 1);
#else
    const float sa = cell[RAY_SOURCE + !along_x], end = sa + ray_component(cell, !along_x, u, 0);
    const float low = clamp(fmin(sa, end), (float)first - 1.0f, (float)(first + count));
    const float high = clamp(fmax(sa, end), (float)first - 1.0f, (float)(first + count));
    return (int2)(max((int)ceil(low), first), min((int)floor(high), first + count - 1));
#endif
}

/* Narrows `planes` to those on which b = sb + g (i - sa) may be between two bounds for any slope g from g0 to g1. */
RAY_INLINE int2 planes_within(const int2 planes, const float sa, const float sb, const float g0, const float g1,
                              const float below, const float above)
{
#if RAY_PARALLEL /* here b = g + sb i */
    const float per = 1.0f / (fabs(sb) > 1e-9f ? sb : 1e-9f), p = (below - fmax(g0, g1)) * per, q = (above - fmin(g0, g1)) * per;
    const float low = fmin(p, q) - CLIP_MARGIN, high = fmax(p, q) + CLIP_MARGIN;
#else
    if (g0 * g1 <= 0.0f || (sa > (float)planes.x && sa < (float)planes.y))
        return planes;
    const float p0 = (below - sb) / g0, p1 = (below - sb) / g1, q0 = (above - sb) / g0, q1 = (above - sb) / g1;
    const float low = sa + fmin(fmin(p0, p1), fmin(q0, q1)) - CLIP_MARGIN;
    const float high = sa + fmax(fmax(p0, p1), fmax(q0, q1)) + CLIP_MARGIN;
#endif
    return (int2)(max(planes.x, (int)ceil(clamp(low, (float)planes.x, (float)planes.y + 1.0f))),
                  min(planes.y, (int)floor(clamp(high, (float)planes.x - 1.0f, (float)planes.y))));
}
