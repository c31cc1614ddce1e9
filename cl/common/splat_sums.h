/* Sums over the pixels of a splat, per time cell, for the chain rule (splat_chain.cl). They overwrite the splat's record
   from SUMS on, which is no longer needed then. The indices of the sums: */
#define SUM_W 0          /* gradient x value: dL/d(log amplitude) */
#define SUM_IK 1         /* dL/d(1/kappa) */
#define SUM_B 7          /* dL/dB with B = 1 + b.D; then dL/dB times D.u and times D.v */
#define SUM_BU 8
#define SUM_BV 9
#if MOVING
#define SUMS 3           /* after ACROSS_V, before ACROSS_U: the chain rule still needs S */
#define SUM_COUNT 12     /* sums in the coordinates of common/splat_moving.h, which lose no digits */
#define SUM_ZZ 2         /* dL/d(num) times z^2, z across and across^2 */
#define SUM_ZC 3
#define SUM_CC 4
#define SUM_Z 5          /* sums of dL/d(num) z and of dL/d(num) across, for dL/d(centre) */
#define SUM_C 6
#define SUM_TZ 10        /* dL/d(num) times t z and t across, with the time t, for dL/d(path) */
#define SUM_TC 11
#else
#define SUMS 0           /* first index of the sums in the record */
#define SUM_COUNT 10     /* number of sums per splat */
#define SUM_UU 2         /* dL/dS11, half of dL/dS12, dL/dS22 */
#define SUM_UV 3
#define SUM_VV 4
#define SUM_U 5          /* dL/d(num) times u and v from the centre, for dL/d(centre) */
#define SUM_V 6
#endif
