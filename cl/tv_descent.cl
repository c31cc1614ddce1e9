/* Gradient of the isotropic total variation, the sum of |backward difference| over voxels, for ASD-POCS (Sidky and Pan,
   Phys. Med. Biol. 53 (2008) 4777). Volumes (nz, ny, nx) have no padding; differences end at the first voxel. A work-item
   takes one voxel. Twin: objective/tv.py. A voxel without a neighbour along y or z is compared with itself, because a branch
   would be slow (see tv_prox.cl). */

/* row, slice: the distance in floats to the neighbours; 0 without one, which makes the difference 0. */
static inline float3 backward_difference(__global const float *volume, const size_t at, const int x, const size_t row,
                                         const size_t slice)
{
    const float here = volume[at];
    return (float3)(x > 0 ? here - volume[at - 1] : 0.0f, here - volume[at - row], here - volume[at - slice]);
}

static inline float inverse_length(const float3 d, const float least)
{
    return 1.0f / (sqrt(d.x * d.x + d.y * d.y + d.z * d.z) + least);
}

/* least: added to the length of differences, because the gradient divides by this length, which is 0 in flat regions. */
__kernel void tv_gradient(__global const float *volume, const int4 shape, const float least, __global float *gradient)
{
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), z = (int)get_global_id(2);
    if (x >= shape.x)
        return;
    const size_t row = (size_t)shape.x, slice = row * shape.y;
    const size_t at = z * slice + y * row + x;
    const size_t back_y = y > 0 ? row : 0, back_z = z > 0 ? slice : 0;
    const size_t ahead_y = y + 1 < shape.y ? row : 0, ahead_z = z + 1 < shape.z ? slice : 0;
    const float3 own = backward_difference(volume, at, x, back_y, back_z);
    float sum = (own.x + own.y + own.z) * inverse_length(own, least);
    if (x + 1 < shape.x) {
        const float3 d = backward_difference(volume, at + 1, x + 1, back_y, back_z);
        sum -= d.x * inverse_length(d, least);
    }
    /* Without a neighbour these differences are 0. */
    const float3 below = backward_difference(volume, at + ahead_y, x, ahead_y, back_z);
    sum -= below.y * inverse_length(below, least);
    const float3 above = backward_difference(volume, at + ahead_z, x, back_y, ahead_z);
    sum -= above.z * inverse_length(above, least);
    gradient[at] = sum;
}
