/* Copies plain arrays (nz, ny, nx) into the padded layouts of operators and back. Element (z, y, x) of an array is
   strides.s0 + y strides.s1 + z strides.s2 + x floats after its start. Twins: NumPy's slices and swapaxes,
   in the tests of the operators. */
#include "common/lanes.h"

static inline size_t row_of(const long4 strides, const int y, const int z)
{
    return (size_t)(strides.s0 + y * strides.s1 + z * strides.s2);
}

/* A work-item copies LANES elements of a row, and writes nothing after the row. */
__kernel void move_rows(
    __global const float *source, const long4 from, __global float *target, const long4 to, const int rows, const int width)
{
    const int x = (int)get_global_id(0) * LANES, y = (int)get_global_id(1), z = (int)get_global_id(2);
    if (x >= width)
        return;
    source += row_of(from, y, z) + x;
    target += row_of(to, y, z) + x;
    if (x + LANES <= width)
        V_STORE(V_LOAD(source), target);
    else
        for (int k = 0; k < width - x; ++k)
            target[k] = source[k];
}

/* Copies and transposes rows and columns. A work-item takes a tile of TILE by TILE elements. */
__kernel void move_turned(
    __global const float *source, const long4 from, __global float *target, const long4 to, const int rows, const int width)
{
    const int x0 = (int)get_global_id(0) * TILE, y0 = (int)get_global_id(1) * TILE, z = (int)get_global_id(2);
    const int x1 = min(x0 + TILE, width), y1 = min(y0 + TILE, rows);
    for (int x = x0; x < x1; ++x) {
        __global float *column = target + row_of(to, x, z);
        for (int y = y0; y < y1; ++y)
            column[y] = source[row_of(from, y, z) + x];
    }
}
