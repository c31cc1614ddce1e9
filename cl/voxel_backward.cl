/* Adjoint of voxel_forward.cl. voxel_backward sums moments of value · dL/d(volume) over a Gaussian's voxels, and
   voxel_chain computes gradients from these sums. In voxel_backward, a CPU's work-item takes a Gaussian, with vectors along
   rows; a GPU's work-group of GROUP items takes one, with ACROSS items along a row. */
#include "common/gradient.h"
#include "common/group_sums.h"
#include "common/voxel.h"

#define SUMS 16
#define SUM_COUNT 10

#if GROUP > 1
#define ROW_OF_GROUP ((int)get_local_id(1))
#define PLACE_IN_ROW ((int)get_local_id(0))
#else
#define ROW_OF_GROUP 0
#define PLACE_IN_ROW 0
#endif

/* The voxels of a row to visit: all in the bounding box on a CPU; on a GPU only those within the cutoff, to save time. */
ALWAYS_INLINE int2 voxel_span(const voxel_row r, const int lo, const int hi, const float limit)
{
#if GROUP > 1
    const float per = 1.0f / r.u11, reach = fabs(sqrt(max(limit - r.k, 0.0f)) * per), far = 4e6f;
    const float middle = r.x_rest - r.a0 * per;
    return (int2)(max(lo, r.x_whole + convert_int(ceil(clamp(middle - reach - 0.01f, -far, far)))),
                  min(hi, r.x_whole + convert_int(floor(clamp(middle + reach + 0.01f, -far, far)))));
#else
    return (int2)(lo, hi);
#endif
}

__kernel void voxel_backward(
    __global const float *records, __global const float *by_volume, /* guard, then (z, y, pitch) */
    const int4 shape, const int pitch, const int count, const float cutoff2,
    __global float *sums)            /* (stride, SUMS): sums of w = value dL/d(volume), of w (x y z), of w (xx xy xz yy yz zz) */
{
    const int g = (int)get_global_id(0) / ACROSS;
#if GROUP == 1 /* Larger groups need no test, and in PoCL 3.0 a return before barriers leads to wrong writes. */
    if (g >= count)
        return;
#endif
    const float limit = cutoff2 > 0.0f ? cutoff2 : MAXFLOAT;
    __global const float *voxel_record = records + (size_t)g * VOXEL_RECORD;
    __global const int *record_as_int = (__global const int *)voxel_record;
    __global float *out = sums + (size_t)g * SUMS;
    vf w_ = (vf)(0.0f), x_ = w_, y_ = w_, z_ = w_, xx = w_, xy = w_, xz = w_, yy = w_, yz = w_, zz = w_;
    for (int z = record_as_int[VOX_LO + 2]; z <= record_as_int[VOX_HI + 2]; ++z)
        for (int y = record_as_int[VOX_LO + 1] + ROW_OF_GROUP; y <= record_as_int[VOX_HI + 1]; y += GROUP / ACROSS) {
            const voxel_row r = voxel_row_at(voxel_record, y, z);
            if (r.k > limit) /* the row crosses a corner of the bounding box, beyond the cutoff */
                continue;
            const int2 span = voxel_span(r, record_as_int[VOX_LO], record_as_int[VOX_HI], limit);
            __global const float *row = by_volume + IMAGE_GUARD + ((size_t)z * shape.y + y) * pitch;
            for (int x = span.x + PLACE_IN_ROW; x <= span.y; x += LANES * ACROSS) {
                const vf dx = voxel_dx(r, x);
                const vf w = voxel_value(r, dx, V_LOAD(row + x), limit);
                const vf wx = w * dx;
                w_ += w;
                x_ += wx;
                y_ += w * r.dy;
                z_ += w * r.dz;
                xx += wx * dx;
                xy += wx * r.dy;
                xz += wx * r.dz;
                yy += w * (r.dy * r.dy);
                yz += w * (r.dy * r.dz);
                zz += w * (r.dz * r.dz);
            }
        }
    const vf all[SUM_COUNT] = {w_, x_, y_, z_, xx, xy, xz, yy, yz, zz};
#if GROUP > 1
    __local float tree[SUM_COUNT * GROUP];
    if (record_as_int[VOX_HI + 2] >= record_as_int[VOX_LO + 2]) /* most Gaussians do not touch a small volume */
        group_sums(all, SUM_COUNT, tree, out);
    else
        for (int f = GROUP_ITEM; f < SUM_COUNT; f += GROUP)
            out[f] = 0.0f;
#else
    for (int f = 0; f < SUM_COUNT; ++f)
        out[f] = v_sum(all[f]);
#endif
}

__kernel void voxel_chain(
    __global const float *gaussians, __global const float *sums, const float4 pitch, const int stride,
    const int add, const float weight,
    __global float *gradients)       /* (13, stride); does not change the last two rows, dL/d(centre u, v) */
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= stride)
        return;
    float fields[SUM_COUNT * LANES];
    gather_sums(sums + (size_t)first * SUMS, SUMS, SUM_COUNT, fields);
    const gaussian g = gaussian_load(gaussians, first, stride);
    const v3 scale = g.scale, inv = g.inv_scale;
    const frame3 axes = g.axes;
    const v3 inv2 = v3_mul(inv, inv);
    const vf w = weight * V_LOAD(fields);
    const v3 n = to_local(axes, v3_make(weight * pitch.x * V_LOAD(fields + LANES),
                                        weight * pitch.y * V_LOAD(fields + 2 * LANES),
                                        weight * pitch.z * V_LOAD(fields + 3 * LANES)));
    /* Second moments in world coordinates, then along the Gaussian's own axes. */
    const vf xx = weight * pitch.x * pitch.x * V_LOAD(fields + 4 * LANES);
    const vf xy = weight * pitch.x * pitch.y * V_LOAD(fields + 5 * LANES);
    const vf xz = weight * pitch.x * pitch.z * V_LOAD(fields + 6 * LANES);
    const vf yy = weight * pitch.y * pitch.y * V_LOAD(fields + 7 * LANES);
    const vf yz = weight * pitch.y * pitch.z * V_LOAD(fields + 8 * LANES);
    const vf zz = weight * pitch.z * pitch.z * V_LOAD(fields + 9 * LANES);
    const v3 na = v3_make(xx * axes.a.x + xy * axes.a.y + xz * axes.a.z, xy * axes.a.x + yy * axes.a.y + yz * axes.a.z,
                          xz * axes.a.x + yz * axes.a.y + zz * axes.a.z);
    const v3 nb = v3_make(xx * axes.b.x + xy * axes.b.y + xz * axes.b.z, xy * axes.b.x + yy * axes.b.y + yz * axes.b.z,
                          xz * axes.b.x + yz * axes.b.y + zz * axes.b.z);
    const v3 nc = v3_make(xx * axes.c.x + xy * axes.c.y + xz * axes.c.z, xy * axes.c.x + yy * axes.c.y + yz * axes.c.z,
                          xz * axes.c.x + yz * axes.c.y + zz * axes.c.z);
    const vf ab = v3_dot(axes.a, nb), ac = v3_dot(axes.a, nc), bc = v3_dot(axes.b, nc);
    const v3 diagonal = v3_make(v3_dot(axes.a, na), v3_dot(axes.b, nb), v3_dot(axes.c, nc));
    const v3 by_mean = to_world(axes, v3_mul(n, inv2));
    const v3 by_scale = v3_mul(v3_mul(diagonal, inv2), inv);
    const v3 torque = v3_make(-bc * (inv.y * inv.z) * out_of_round(scale.y, scale.z, inv.y, inv.z),
                              -ac * (inv.z * inv.x) * out_of_round(scale.z, scale.x, inv.z, inv.x),
                              -ab * (inv.x * inv.y) * out_of_round(scale.x, scale.y, inv.x, inv.y));
    gradient_store(gradients + first, stride, add, by_mean, by_scale, torque, g.qw, g.qx, g.qy, g.qz,
                   w / g.density);
}
