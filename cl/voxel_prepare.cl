/* Computes for every Gaussian, in units of a grid's voxels, the triangular factor of its precision matrix and its bounding
   box. A work-item takes LANES Gaussians. */
#include "common/precise.h"
#include "common/gaussian.h"
#include "common/voxel.h"

__kernel void voxel_prepare(
    __global const float *gaussians,      /* (11, stride): mean, scale, quaternion, density */
    __global const coefficient *matrix,   /* (12): rows give the voxel index x, y, z of a world point */
    const float4 pitch,                   /* size of a voxel along x, y, z */
    const int4 start,                     /* first voxel of the computed part, x y z */
    const int4 shape,                     /* voxels of the computed part along x, y, z */
    const int count, const int stride,
    const float cutoff2,
    __global float *records,              /* (stride, VOXEL_RECORD): see common/voxel.h */
    __global int *extents)                /* (6, stride): lo and hi along x, y, z; empty where hi < lo */
{
    const int first = (int)get_global_id(0) * LANES;
    if (first >= stride)
        return;
    const gaussian g = gaussian_load(gaussians, first, stride);
    const v3 mean = g.mean, scale = g.scale, inv_scale = g.inv_scale;
    const frame3 axes = g.axes;
    const vf inv_det = inv_scale.x * inv_scale.y * inv_scale.z;
    const v3 ex = v3_make(axes.a.x, axes.b.x, axes.c.x);
    const v3 ey = v3_make(axes.a.y, axes.b.y, axes.c.y);
    const v3 ez = v3_make(axes.a.z, axes.b.z, axes.c.z);
    const v3 sx = v3_mul(scale, ex), sy = v3_mul(scale, ey), sz = v3_mul(scale, ez);
    const v3 wx = v3_mul(inv_scale, ex), wy = v3_mul(inv_scale, ey), wz = v3_mul(inv_scale, ez);

    /* QR decomposition of the voxel axes in the Gaussian's whitened frame. Cross products are computed as cofactors, in
       which thin Gaussians lose no digits. */
    const vf u11 = sqrt(v3_dot(wx, wx)), inv_u11 = 1.0f / u11;
    const vf u22 = sqrt(v3_dot(sz, sz)) * inv_det * inv_u11;
    const vf u23 = -v3_dot(sz, sy) * (inv_det * inv_u11) * (inv_det * inv_u11) / u22;
    const vf u33 = inv_det * inv_u11 / u22;
    vf rest[3];
    /* The centre is split on the complete grid, so that a part of a volume gets the same bits as the whole. */
    const vf whole[3] = {wide_split(wide_dot(matrix, mean.x, mean.y, mean.z), rest) - (float)start.x,
                         wide_split(wide_dot(matrix + 4, mean.x, mean.y, mean.z), rest + 1) - (float)start.y,
                         wide_split(wide_dot(matrix + 8, mean.x, mean.y, mean.z), rest + 2) - (float)start.z};
    const vf sigma[3] = {sqrt(v3_dot(sx, sx)) / pitch.x, sqrt(v3_dot(sy, sy)) / pitch.y, sqrt(v3_dot(sz, sz)) / pitch.z};
    const int sizes[3] = {shape.x, shape.y, shape.z};

    float fields[VOX_WHOLE * LANES];
    int bounds[(VOX_HI + 3 - VOX_WHOLE) * LANES];
    V_STORE(rest[0], fields);
    V_STORE(rest[1], fields + LANES);
    V_STORE(rest[2], fields + 2 * LANES);
    V_STORE(u11 * pitch.x, fields + VOX_U11 * LANES);
    V_STORE(v3_dot(wx, wy) * inv_u11 * pitch.y, fields + VOX_U12 * LANES);
    V_STORE(v3_dot(wx, wz) * inv_u11 * pitch.z, fields + VOX_U13 * LANES);
    V_STORE(u22 * pitch.y, fields + VOX_U22 * LANES);
    V_STORE(u23 * pitch.z, fields + VOX_U23 * LANES);
    V_STORE(u33 * pitch.z, fields + VOX_U33 * LANES);
    V_STORE(g.density, fields + VOX_DENSITY * LANES);
    vi drawn = V_INT((vf)(first) + V_IOTA) < count;
    vi lo[3], hi[3];
    for (int k = 0; k < 3; ++k) {
        lo[k] = (vi)(0);
        hi[k] = (vi)(sizes[k] - 1);
        if (cutoff2 > 0.0f) {
            const vf reach = sqrt(cutoff2) * sigma[k] * 1.0001f + 0.002f;
            lo[k] = max(lo[k], V_INT(ceil(clamp(whole[k] + (rest[k] - reach), -4e6f, 4e6f))));
            hi[k] = min(hi[k], V_INT(floor(clamp(whole[k] + (rest[k] + reach), -4e6f, 4e6f))));
        }
        drawn &= hi[k] >= lo[k];
    }
    for (int k = 0; k < 3; ++k) {
        lo[k] = VI_PICK(1, lo[k], drawn);
        hi[k] = VI_PICK(0, hi[k], drawn);
        VI_STORE(V_INT(whole[k]), bounds + k * LANES);
        VI_STORE(lo[k], bounds + (3 + k) * LANES);
        VI_STORE(hi[k], bounds + (6 + k) * LANES);
        VI_STORE(lo[k], extents + (size_t)(2 * k) * stride + first);
        VI_STORE(hi[k], extents + (size_t)(2 * k + 1) * stride + first);
    }
    for (int lane = 0; lane < LANES; ++lane) {
        __global float *voxel_record = records + (size_t)(first + lane) * VOXEL_RECORD;
        __global int *record_as_int = (__global int *)voxel_record;
        for (int f = 0; f < VOX_WHOLE; ++f)
            voxel_record[f] = fields[f * LANES + lane];
        for (int f = VOX_WHOLE; f < VOX_HI + 3; ++f)
            record_as_int[f] = bounds[(f - VOX_WHOLE) * LANES + lane];
    }
}
