/* The value of a pixel as the mean over several rays, which are the pixels of a finer panel; and the transpose. Pixel
   (frame, row, column) of the finer panel is at strides.s0 + frame strides.s3 + row strides.s2 + column strides.s1 floats.
   A work-item takes a pixel of frames (F, rows, columns), from frame `first` on. Twins: block_means and NumPy's repeat. */

static inline size_t block_of(const long4 strides, const int2 parts)
{
    const long column = get_global_id(0), row = get_global_id(1), frame = get_global_id(2);
    return (size_t)(strides.s0 + frame * strides.s3 + row * parts.y * strides.s2 + column * parts.x * strides.s1);
}

static inline size_t pixel_of(const int first, const int rows, const int columns)
{
    return ((first + get_global_id(2)) * (size_t)rows + get_global_id(1)) * columns + get_global_id(0);
}

/* parts: the number of rays of a pixel along a row, and along a column. */
__kernel void subray_means(
    __global const float *fine, const long4 strides, const int2 parts, __global float *frames, const int first,
    const int rows, const int columns)
{
    if ((int)get_global_id(0) >= columns)
        return;
    __global const float *block = fine + block_of(strides, parts);
    float sum = 0.0f;
    for (int v = 0; v < parts.y; ++v)
        for (int u = 0; u < parts.x; ++u)
            sum += block[v * strides.s2 + u * strides.s1];
    frames[pixel_of(first, rows, columns)] = sum / (parts.x * parts.y);
}

__kernel void spread_subrays(
    __global const float *frames, const int first, const int rows, const int columns, __global float *fine,
    const long4 strides, const int2 parts)
{
    if ((int)get_global_id(0) >= columns)
        return;
    const float share = frames[pixel_of(first, rows, columns)] / (parts.x * parts.y);
    __global float *block = fine + block_of(strides, parts);
    for (int v = 0; v < parts.y; ++v)
        for (int u = 0; u < parts.x; ++u)
            block[v * strides.s2 + u * strides.s1] = share;
}
