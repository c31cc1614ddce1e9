/* Proximal map of the isotropic total variation by fast gradient projection on the dual (Beck and Teboulle, IEEE
   Trans. Image Process. 18 (2009) 2419). Volumes (nz, ny, nx) without padding; the dual has three planes, one per axis,
   with forward differences that end at the last voxel. A work-item takes one voxel. Twin: objective/tv.py.
   `shape`: voxels along x, y and z, and states of an object that changes. Of several states (K, nz, ny, nx) the dual has a
   fourth plane, the differences between a state and the next one. Its length counts apart from that of the other three. */

__kernel void tv_primal(
    __global const float *observed, __global const float *moved, /* (K, nz, ny, nx); (3 or 4, K, nz, ny, nx): x, y, z, time */
    const int4 shape, const float4 axis_weight, const float weight, const int nonnegative,
    __global float *volume)
{
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), all = (int)get_global_id(2);
    const int state = all / shape.z, z = all % shape.z;
    if (x >= shape.x)
        return;
    const size_t row = (size_t)shape.x, slice = row * shape.y, volume_size = slice * shape.z, plane = volume_size * shape.w;
    const size_t at = all * slice + y * row + x;
    __global const float *ry = moved + plane, *rz = moved + 2 * plane;
    float divergence = axis_weight.x * ((x > 0 ? moved[at - 1] : 0.0f) - moved[at]);
    divergence += axis_weight.y * ((y > 0 ? ry[at - row] : 0.0f) - ry[at]);
    divergence += axis_weight.z * ((z > 0 ? rz[at - slice] : 0.0f) - rz[at]);
    if (shape.w > 1) {
        __global const float *rt = moved + 3 * plane;
        divergence += axis_weight.w * ((state > 0 ? rt[at - volume_size] : 0.0f) - rt[at]);
    }
    const float value = observed[at] - weight * divergence;
    volume[at] = nonnegative ? fmax(value, 0.0f) : value;
}

__kernel void tv_dual(
    __global const float *volume, const int4 shape, const float4 axis_weight,
    const float step, const float time_step, /* one over the Lipschitz constant times the weight */
    const float momentum,
    __global const float *from,       /* moved; at first the dual itself */
    __global float *dual, __global float *moved)
{
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), all = (int)get_global_id(2);
    const int state = all / shape.z, z = all % shape.z;
    if (x >= shape.x)
        return;
    const size_t row = (size_t)shape.x, slice = row * shape.y, volume_size = slice * shape.z, plane = volume_size * shape.w;
    const size_t at = all * slice + y * row + x;
    const float here = volume[at];
    const float gx = x + 1 < shape.x ? axis_weight.x * (volume[at + 1] - here) : 0.0f;
    const float gy = y + 1 < shape.y ? axis_weight.y * (volume[at + row] - here) : 0.0f;
    const float gz = z + 1 < shape.z ? axis_weight.z * (volume[at + slice] - here) : 0.0f;
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
    if (shape.w > 1) {
        const float gt = state + 1 < shape.w ? axis_weight.w * (volume[at + volume_size] - here) : 0.0f;
        const float pt = clamp(from[at + 3 * plane] + time_step * gt, -1.0f, 1.0f);
        moved[at + 3 * plane] = pt + momentum * (pt - dual[at + 3 * plane]);
        dual[at + 3 * plane] = pt;
    }
}
