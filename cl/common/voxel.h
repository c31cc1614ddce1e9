/* What the voxeliser keeps of a Gaussian on a grid: with voxel offset D from the centre,
   value = density exp(-|U D|^2 / 2), U upper triangular. */
#include "common/falling_exp2.h"

#define VOXEL_RECORD 20
#define VOX_REST 0      /* 3: centre minus its nearest voxel, x y z */
#define VOX_U11 3
#define VOX_U12 4
#define VOX_U13 5
#define VOX_U22 6
#define VOX_U23 7
#define VOX_U33 8
#define VOX_DENSITY 9
#define VOX_WHOLE 10    /* 3 ints */
#define VOX_LO 13       /* 3 ints: x y z; empty when HI.z < LO.z */
#define VOX_HI 16
