"""Every tolerance of the kernel tests, with its reason and what was measured (PoCL, 2 cores, AVX-512).

Relative errors of images are to the peak of the image, of gradients the norm of the difference over the norm.
"""
# --- rounding ------------------------------------------------------------------------------------------------
FLOAT64 = 1e-9  # two float64 ways to one number of order 1, or its relative error
SUMS = 1e-12  # sums of float32 products in float64, or in pairs of float32, over the norms (5e-14)
FLOAT32 = 1e-5  # the same where one way ends, or runs through a few operations, in float32
# --- float64 oracles -----------------------------------------------------------------------------------------
# closed form against Gauss–Legendre along the ray: q = κ − b²/a loses κ = (distance / scale)² ≈ 1e4 last places
TWIN_QUADRATURE = 5e-12  # measured 2e-12
# --- splat ---------------------------------------------------------------------------------------------------
SPLAT_COMPACT = 1e-5  # goal for σ ≥ 0.5 px, aspect ≤ 10 on 512²; float32 rounding of the exponent leaves 5e-7
SPLAT_NEEDLE = 1e-4  # goal up to aspect 1000: the Gram form keeps digits, a covariance would lose all (5e-6)
SPLAT_CLOUD = 1e-5  # sums of a few splats on a small detector (1e-6)
SPLAT_AFFINE = 1e-5  # the same arithmetic without Q (1e-6)
CUTOFF_EDGE_SIGMA = 1e-4  # float32 may decide differently about pixels this close to the cutoff's ellipse
CUTOFF_EDGE_NEEDLE = 1e-3  # across a needle a float32 position is a larger share of σ
MERGED_FRAME = 1e-5  # Eq. 3 in one launch: a sum of splats, no other error than theirs (1e-6)
BRUTE_FORCE = 1e-5  # per-line cells at the brute force's own times: the same sums in another order
# --- splats that move through a segment ------------------------------------------------------------------------
# of the peak, against quadrature in time, with the rules' bound out of the way: float32 and the polynomial of erf
SPLAT_MOVING = 1e-5  # measured 2e-6
# of the still peak, the worst pixel over ``time_error``: the remainders of the rules are cut at twice that (0.2 to 2)
TIME_RULE = 2.2
# float32 may decide differently about pixels this close to the edge of the path's outline
CUTOFF_EDGE_MOVING = 1e-3
MOVING_GRADIENT = 1e-4  # goal 1e-3; at rest 3e-7, at 50 pixels per segment 3e-6
# error over that of a quarter as many segments: straight paths and constant conics are second order (0.09)
SEGMENTS_ORDER = 0.16
EXACT_OVER_MICRO_VIEWS = 1 / 3  # goal of the design at equal time; at the default bound 0.1 to 0.2
# --- intensity model ------------------------------------------------------------------------------------------
INTENSITY_FRAME = 1e-5  # SPLAT_MOVING and a few float32 exponentials
# --- gradients -----------------------------------------------------------------------------------------------
GRADIENT = 1e-4  # goal 1e-3; float32 sums over a footprint leave 1e-6 to 2e-5
FINITE_DIFFERENCE_STEP = 1e-6  # in units of 1: truncation 1e-10, cancellation 1e-10 in float64
# --- micro-views against the brute force ------------------------------------------------------------------------
MICRO_VIEWS_FINE = 1e-2  # one strip per line, 12 sub-intervals: strip middles miss by up to half a line (4.4e-3)
MICRO_VIEWS_ORDER = 8.0  # one micro-view (static) must be so much worse, or the test saw no motion (13 to 18)
# --- voxeliser and rays --------------------------------------------------------------------------------------
VOXEL = 1e-5  # of the largest density: float32 rounding of the exponent (1e-6)
# a brick counts voxels from its own corner: the float32 rest of a centre may round the other way
VOXEL_NEEDLE = 2e-4  # aspect 1000: float32 centres and factors move a needle by a share of its width
# one item adds up 15,750 voxels in float32, a group few each: by scale 9e-5 and 9e-6 from float64 (rusticl: 1.1e-4, 9e-6)
SERIAL_SUM = 2e-4
RAYS = 1e-5  # of the peak: some tens of float32 samples, positions to 1e-6 of a voxel
# of the peak: a voxel has few samples, whose positions (1e-5 of a voxel, 200 away from the source) do not average out
# of the peak, where an inverse field is found from the field's values at voxels (7e-4)
GRIDDED_FIELD = 5e-3
COMMON_TIMES = 1e-3  # relative RMS of 5 times to an exposure of 14.4 degrees; measured up to 7e-4
RAYS_BACK = 3e-5  # measured 1.2e-5
BRICKS = 2e-6  # of the largest: a ray's samples are summed brick by brick, in another order (4e-7)
ADJOINT = 1e-5  # goal of the design; sums in float32 in two different orders
# --- rays through a neural field ---------------------------------------------------------------------------------
RAY_SAMPLES = 1e-3  # goal; of the peak (smooth fields, one draw) or of the norm (sharp edge, mean of draws)
RAY_SAMPLES_SHARP = 0.05  # of the norm, one draw: a step in an interval counts or not (0.02; 0.03 a sample)
# --- FDK -----------------------------------------------------------------------------------------------------
BACKPROJECTION = 2e-5  # bilinear positions to some 1e-6 pixels in float32, samples of order 1
FDK_MEAN = 0.02  # mean inside a sphere: 90 views, 32³ voxels, a cone of ±10°, samples of the edge
FDK_PARTIAL = 0.012  # the same at 120 views, displaced and short (0.0075); wrong weights leave 0.024 to 0.4
FDK_ENDS = 0.1  # relative RMS where some views miss voxels, against a panel that all views see
FDK_LINES = 1.08  # error of a rolling scan over that of a gantry at rest (0.99 to 1.05)
RAMP = 1e-5  # float32 result of a float64 FFT
# --- objective -----------------------------------------------------------------------------------------------
IMAGE_VALUE = 1e-5  # float32 sums of a frame against float64
IMAGE_GRADIENT = 2e-5  # of the largest: variances as E[x²] − E[x]² lose some digits in float32
TWIN_GRADIENT = 1e-6  # float64 formula against central differences with a step of 1e-6
SSIM_REFERENCE = 1e-12  # the same float64 formula as scikit-image's, mean over the image
TV_VALUE = 1e-5
TV_GRADIENT = 1e-7  # a sum of six signs times a weight
TV_MAP = 2e-5  # some steps on numbers of order 1 in float32; unit vectors near flat places amplify rounding
PARAMETER_GRADIENT = 1e-5  # of the largest: float32 ratio of scales, squared
# --- optimiser -----------------------------------------------------------------------------------------------
ADAM_TEXTBOOK = 1e-6  # of the largest rate: ε = 1e-15 is folded differently, gradients go down to 1e-6
ADAM_KERNEL = 5e-5  # of the largest rate, over some steps on raw numbers near 1 in float32
ADAM_SECOND_MOMENT = 2e-5  # 1 − 0.999 in float32 is 1.3e-5 too small: a common factor, 6e-6 of every step
# --- activation ----------------------------------------------------------------------------------------------
ACTIVATION_INVERSE = 1e-7  # logit and the inverse of softplus lose digits near their ends
ACTIVATION_MARGIN = 1.001e-4  # a scale at its bound is inverted from 1e-4 of the span inside
# --- simulation ----------------------------------------------------------------------------------------------
ANALYTIC_FRAME = 1e-6  # float32 frames of float64 closed forms
# default samples against four times as many, relative L2 of Shepp–Logan: 6e-4, on finer detectors 1.0e-3
TIME_SAMPLING = 2e-3
# relative L2 of 64³ voxels to the closed form: Shepp–Logan's skull is a voxel thick (0.065)
VOXEL_SOURCE = 0.08
# of the peak, a blob whose σ is two voxels: a tenth of a voxel from its place changes it by 0.03 (0.021)
MOVING_FRAME = 0.03
# --- reconstruction ------------------------------------------------------------------------------------------
WHOLE_VALUE = 1e-5  # the image terms in float32
# goal 1e-3, through everything (9e-7); other devices may sign tiny TV differences otherwise
WHOLE_GRADIENT = 1e-4
LAUNCH_SHAPE = 1e-3  # a few iterations in another order of sums; Adam enlarges what is near 0 (3e-5)
SCALE_LAW = 1e-2  # 30 steps: rounding decides signs of L1 near its kink (1.1e-3); powers of two are exact
# counts are divided in float64 but come out float32 (0 here); one last place would act as above
CLOUD_VOLUME = 2e-3  # a voxel at the cutoff's edge (0.1 % of a peak) may fall on the other side
# --- iterative methods ---------------------------------------------------------------------------------------
ITERATIVE_TWIN = 1e-4  # of the largest voxel: a few passes in float32 against float64 with the matrix
KRYLOV = 1e-3  # relative, of CGLS against LSQR: float32 directions lose orthogonality
CONVERGED = 1e-3  # relative distance of a long run's objective from its minimum

# Frames' gradients are rounded to float32 before they are added, a few times 2^-24; measured 1e-7 to 4e-7.
RANK_GRADIENT = 1e-6
# Voxel methods on several ranks, which add up their own frames first; measured up to 7e-7 after 8 iterations.
RANK_VOLUME = 1e-4  # sums in another order; TV descents of asd-pocs enlarge that: 4e-5 with intensities, others 1e-5
# --- voxel methods on the device -------------------------------------------------------------------------------
# relative L2 to the same lines over NumPy's arrays: rounding of single operations (1e-7), which steps of a fixed length
# down a gradient of unit vectors do not damp
RESIDENT = dict.fromkeys(("sart", "os-sart", "sirt", "cgls", "fista", "fista-tv"), 1e-6) | {"asd-pocs": 2e-4}
