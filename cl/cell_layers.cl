/* Averages intensities of frames (F, rows, columns) over their time cells, one layer of cells after the other. A layer has
   line integrals p of one cell per line, whose weight is w. Computes the frames, -log(sum w exp(-p)), and the softmax
   weights, w exp(-p) / sum w exp(-p), without overflow. Weights are (F, lines); a line is a row, or a column if `by_row` is
   0. A work-item takes one pixel. Twin: detector/attenuation.py. */

#define PIXEL                                                                                              \
    const int u = (int)get_global_id(0), v = (int)get_global_id(1), f = (int)get_global_id(2);             \
    if (u >= columns)                                                                                      \
        return;                                                                                            \
    const size_t at = ((size_t)f * rows + v) * columns + u;                                                \
    const float weight = weights[by_row ? (size_t)f * rows + v : (size_t)f * columns + u];

/* least = the smallest p of all layers so far whose weight is not 0. It must be infinity before the first. */
__kernel void layer_least(
    __global const float *p, __global const float *weights, __global float *least,
    const int rows, const int columns, const int by_row)
{
    PIXEL
    if (weight > 0.0f)
        least[at] = fmin(least[at], p[at]);
}

/* Replaces p by w exp(least - p), and adds this to `total`, the sum over the layers so far. */
__kernel void layer_seen(
    __global float *p, __global const float *weights, __global const float *least, __global float *total,
    const int rows, const int columns, const int by_row)
{
    PIXEL
    const float seen = weight > 0.0f ? weight * exp(least[at] - p[at]) : 0.0f;
    p[at] = seen;
    total[at] += seen;
}

/* Replaces `least` by the frame, and `total` by its inverse. Both become 0 where all weights are 0. */
__kernel void layer_average(const long count, __global float *least, __global float *total)
{
    const size_t at = get_global_id(0);
    if (at >= count)
        return;
    const int any = total[at] > 0.0f;
    least[at] = any ? least[at] - log(total[at]) : 0.0f;
    total[at] = any ? 1.0f / total[at] : 0.0f;
}
