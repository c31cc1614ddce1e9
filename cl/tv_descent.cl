/* Gradient of the isotropic total variation, the sum of |backward difference| over voxels, as ASD-POCS descends it
   (Sidky and Pan, Phys. Med. Biol. 53 (2008) 4777). Volume (nz, ny, nx) without padding; differences end at the first
   voxel. A work-item takes one voxel. Twin: objective/tv_descent.py. */

static inline float3 backward_difference(__global const float *volume, const size_t at, const int x, const int y, const int z,
                                  const size_t row, const size_t slice)
{
    const float here = volume[at];
    return (float3)(x > 0 ? here - volume[at - 1] : 0.0f, y > 0 ? here - volume[at - row] : 0.0f,
                    z > 0 ? here - volume[at - slice] : 0.0f);
}

static inline float inverse_length(const float3 d, const float least)
{
    return 1.0f / (sqrt(d.x * d.x + d.y * d.y + d.z * d.z) + least);
}

/* least: keeps flat regions from dividing by zero */
__kernel void tv_gradient(__global const float *volume, const int4 shape, const float least, __global float *gradient)
{
    const int x = (int)get_global_id(0), y = (int)get_global_id(1), z = (int)get_global_id(2);
    if (x >= shape.x)
        return;
    const size_t row = (size_t)shape.x, slice = row * shape.y;
    const size_t at = z * slice + y * row + x;
    const float3 own = backward_difference(volume, at, x, y, z, row, slice);
    float sum = (own.x + own.y + own.z) * inverse_length(own, least);
    if (x + 1 < shape.x) {
        const float3 d = backward_difference(volume, at + 1, x + 1, y, z, row, slice);
        sum -= d.x * inverse_length(d, least);
    }
    if (y + 1 < shape.y) {
        const float3 d = backward_difference(volume, at + row, x, y + 1, z, row, slice);
        sum -= d.y * inverse_length(d, least);
    }
    if (z + 1 < shape.z) {
        const float3 d = backward_difference(volume, at + slice, x, y, z + 1, row, slice);
        sum -= d.z * inverse_length(d, least);
    }
    gradient[at] = sum;
}
