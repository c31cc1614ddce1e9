/* Proximal map of the isotropic total variation by fast gradient projection on the dual (Beck and Teboulle, IEEE Trans.
   Image Process. 18 (2009) 2419). Volumes (nz, ny, nx) have no padding. The dual variable has three components, one for the
   forward differences along each axis. A work-item takes one voxel. Twin: objective/tv.py.
   shape: voxels along x, y and z, and the number of states of an object that changes. With several states (K, nz, ny, nx;
   build option STATES) the dual has a fourth component, for differences from a state to the next. The total variation then
   has the absolute value of this difference, added to the length of the other three.
   A voxel without a neighbour reads itself instead. A branch would be compiled to a masked access beyond the buffer, which
   takes ten times as long although no lane needs it. */

__kernel void tv_primal(
    __global const float *observed, __global const float *moved, /* (K, nz, ny, nx); (3 or 4, K, nz, ny, nx): x, y, z, time */
    const int4 shape, const float4 axis_weight, const float weight, const int nonnegative,
    __global float *volume)
{
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), all = (int)get_global_id(2);
    const int z = all % shape.z;
    if (x >= shape.x)
        return;
    const size_t row = (size_t)shape.x, slice = row * shape.y, volume_size = slice * shape.z, plane = volume_size * shape.w;
    const size_t at = all * slice + y * row + x;
    __global const float *ry = moved + plane, *rz = moved + 2 * plane;
    float divergence = axis_weight.x * ((x > 0 ? moved[at - 1] : 0.0f) - moved[at]);
    divergence += axis_weight.y * ((y > 0 ? 1.0f : 0.0f) * ry[y > 0 ? at - row : at] - ry[at]);
    divergence += axis_weight.z * ((z > 0 ? 1.0f : 0.0f) * rz[z > 0 ? at - slice : at] - rz[at]);
#if STATES
    __global const float *rt = moved + 3 * plane;
    divergence += axis_weight.w * ((all >= shape.z ? 1.0f : 0.0f) * rt[all >= shape.z ? at - volume_size : at] - rt[at]);
#endif
    const float value = observed[at] - weight * divergence;
    volume[at] = nonnegative ? fmax(value, 0.0f) : value;
}

__kernel void tv_dual(
    __global const float *volume, const int4 shape, const float4 axis_weight,
    const float step, const float time_step, /* the dual's steps along x, y, z and in time, divided by the prior's weight */
    const float momentum,
    __global const float *from,       /* `moved` as the last call wrote it; in the first call `dual` */
    __global float *dual, __global float *moved)
{
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), all = (int)get_global_id(2);
    const int z = all % shape.z;
    if (x >= shape.x)
        return;
    const size_t row = (size_t)shape.x, slice = row * shape.y, volume_size = slice * shape.z, plane = volume_size * shape.w;
    const size_t at = all * slice + y * row + x;
    const float here = volume[at];
    const float gx = x + 1 < shape.x ? axis_weight.x * (volume[at + 1] - here) : 0.0f;
    const float gy = axis_weight.y * (volume[y + 1 < shape.y ? at + row : at] - here);
    const float gz = axis_weight.z * (volume[z + 1 < shape.z ? at + slice : at] - here);
    const float qx = from[at] + step * gx;
    const float qy = from[at + plane] + step * gy;
    const float qz = from[at + 2 * plane] + step * gz;
    const float shrink = 1.0f / fmax(1.0f, sqrt(qx * qx + qy * qy + qz * qz));
    const float px = qx * shrink, py = qy * shrink, pz = qz * shrink;
    moved[at] = px + momentum * (px - dual[at]);
    moved[at + plane] = py + momentum * (py - dual[at + plane]);
    moved[at + 2 * plane] = pz + momentum * (pz - dual[at + 2 * plane]);
    dual[at] = px;
    dual[at + plane] = py;
    dual[at + 2 * plane] = pz;
#if STATES
    const float gt = axis_weight.w * (volume[all < shape.z * (shape.w - 1) ? at + volume_size : at] - here);
    const float pt = clamp(from[at + 3 * plane] + time_step * gt, -1.0f, 1.0f);
    moved[at + 3 * plane] = pt + momentum * (pt - dual[at + 3 * plane]);
    dual[at + 3 * plane] = pt;
#endif
}
