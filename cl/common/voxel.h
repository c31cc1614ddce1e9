/* A Gaussian on a grid, as a record in units of voxels. At the offset D from its centre, its value is
   density exp(-|U D|^2 / 2), where U is upper triangular. */
#include "common/falling_exp2.h"

#ifndef VOXEL_SPACE
#define VOXEL_SPACE __global /* address space of the records */
#endif

#define VOXEL_RECORD 20 /* floats or ints of a record; RECORD_FLOATS in operators/splats/voxelise.py */
#define VOX_REST 0      /* 3 floats: centre minus its nearest voxel, x y z */
#define VOX_U11 3
#define VOX_U12 4
#define VOX_U13 5
#define VOX_U22 6
#define VOX_U23 7
#define VOX_U33 8
#define VOX_DENSITY 9
#define VOX_WHOLE 10    /* 3 ints: the voxel nearest to the centre, x y z */
#define VOX_LO 13       /* 3 ints: the first voxel to visit, x y z; no voxel if HI.z < LO.z */
#define VOX_HI 16

/* A Gaussian on one row of voxels. */
typedef struct { float u11, a0, k, density, dy, dz, x_rest; int x_whole; } voxel_row;

ALWAYS_INLINE voxel_row voxel_row_at(VOXEL_SPACE const float *voxel_record, const int y, const int z)
{
    VOXEL_SPACE const int *record_as_int = (VOXEL_SPACE const int *)voxel_record;
    voxel_row r;
    r.dz = (float)(z - record_as_int[VOX_WHOLE + 2]) - voxel_record[VOX_REST + 2];
    r.dy = (float)(y - record_as_int[VOX_WHOLE + 1]) - voxel_record[VOX_REST + 1];
    r.u11 = voxel_record[VOX_U11];
    r.a0 = voxel_record[VOX_U12] * r.dy + voxel_record[VOX_U13] * r.dz;
    const float b = voxel_record[VOX_U22] * r.dy + voxel_record[VOX_U23] * r.dz, c = voxel_record[VOX_U33] * r.dz;
    r.k = b * b + c * c; /* the smallest |U D|^2 on the row */
    r.density = voxel_record[VOX_DENSITY];
    r.x_rest = voxel_record[VOX_REST];
    r.x_whole = record_as_int[VOX_WHOLE];
    return r;
}

ALWAYS_INLINE vf voxel_dx(const voxel_row r, const int x) { return ((float)(x - r.x_whole) + V_IOTA) - r.x_rest; }

/* The values at offsets dx along the row, times `by`; 0 beyond the cutoff. */
ALWAYS_INLINE vf voxel_value(const voxel_row r, const vf dx, const vf by, const float limit)
{
    const vf a = r.u11 * dx + r.a0;
    const vf q = a * a + r.k;
    return V_PICK(0.0f, by * (r.density * falling_exp2(MINUS_HALF_LOG2E * q)), q <= limit);
}
