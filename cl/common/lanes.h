/* Vectors of LANES floats. With LANES 1 they are scalars, for which OpenCL has other rules: a true comparison gives 1, not
   -1, and there is no select or any. These macros hide the difference. */
#ifndef LANES
#error "build with -DLANES=1, 4, 8 or 16"
#endif

#ifdef __clang__
#define ALWAYS_INLINE static inline __attribute__((always_inline))
#else
#define ALWAYS_INLINE static inline
#endif

#if LANES == 1
typedef float vf;
typedef int vi;
#define WIDE_ALIGNED
#define V_LOAD(p) (*(p))
#define V_STORE(v, p) (*(p) = (v))
#define VI_LOAD(p) (*(p))
#define VI_STORE(v, p) (*(p) = (v))
#define V_IOTA (0.0f)
#define V_PICK(no, yes, condition) ((condition) ? (yes) : (no))
#define VI_PICK(no, yes, condition) ((condition) ? (yes) : (no))
#define V_ANY(condition) (condition)
#define V_FIRST(v) (v)
#define V_LAST(v) (v)
#define V_INT(v) convert_int(v)
#define V_FLOAT(v) convert_float(v)
static inline float v_sum(vf v) { return v; }
#else
#define LANE_PASTE(a, b) a##b
#define LANE_TYPE(a, b) LANE_PASTE(a, b)
typedef LANE_TYPE(float, LANES) vf;
typedef LANE_TYPE(int, LANES) vi;
#ifdef __clang__
/* Replaces PoCL's vloadn and vstoren, which move a vector in up to four parts. A load of the whole vector soon after would
   have to wait for all of them. */
typedef LANE_TYPE(float, LANES) __attribute__((aligned(4))) vf_anywhere;
#define WIDE_ALIGNED __attribute__((aligned(64))) /* so that a vector at a multiple of LANES lies in one cache line */
#define V_OVERLOAD ALWAYS_INLINE __attribute__((overloadable))
V_OVERLOAD vf v_load(__private const float *p) { return *(__private const vf_anywhere *)p; }
V_OVERLOAD vf v_load(__global const float *p) { return *(__global const vf_anywhere *)p; }
V_OVERLOAD vf v_load(__local const float *p) { return *(__local const vf_anywhere *)p; }
V_OVERLOAD void v_store(const vf v, __private float *p) { *(__private vf_anywhere *)p = v; }
V_OVERLOAD void v_store(const vf v, __global float *p) { *(__global vf_anywhere *)p = v; }
V_OVERLOAD void v_store(const vf v, __local float *p) { *(__local vf_anywhere *)p = v; }
#define V_LOAD(p) v_load(p)
#define V_STORE(v, p) v_store((v), (p))
#else
#define WIDE_ALIGNED
#define V_LOAD(p) LANE_TYPE(vload, LANES)(0, (p))
#define V_STORE(v, p) LANE_TYPE(vstore, LANES)((v), 0, (p))
#endif
#define VI_LOAD(p) LANE_TYPE(vload, LANES)(0, (p))
#define VI_STORE(v, p) LANE_TYPE(vstore, LANES)((v), 0, (p))
#define V_PICK(no, yes, condition) select((vf)(no), (vf)(yes), (condition))
#define VI_PICK(no, yes, condition) select((vi)(no), (vi)(yes), (condition))
#define V_ANY(condition) any(condition)
#define V_FIRST(v) ((v).s0)
#define V_INT(v) LANE_TYPE(convert_int, LANES)(v)
#define V_FLOAT(v) LANE_TYPE(convert_float, LANES)(v)
#if LANES == 4
#define V_IOTA ((vf)(0, 1, 2, 3))
#define V_LAST(v) ((v).s3)
#define V_END_OF_HALF(v) ((v).s1)
#define V_HALF(v) ((v).s2)
static inline float v_sum(vf v) { float2 b = v.lo + v.hi; return b.x + b.y; }
#elif LANES == 8
#define V_IOTA ((vf)(0, 1, 2, 3, 4, 5, 6, 7))
#define V_LAST(v) ((v).s7)
#define V_END_OF_HALF(v) ((v).s3)
#define V_HALF(v) ((v).s4)
static inline float v_sum(vf v) { float4 a = v.lo + v.hi; float2 b = a.lo + a.hi; return b.x + b.y; }
#else
#define V_IOTA ((vf)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#define V_LAST(v) ((v).sf)
#define V_END_OF_HALF(v) ((v).s7)
#define V_HALF(v) ((v).s8)
static inline float v_sum(vf v)
{
    float8 c = v.lo + v.hi;
    float4 a = c.lo + c.hi;
    float2 b = a.lo + a.hi;
    return b.x + b.y;
}
#endif
#endif

/* Loads p[i] in each lane. No array in between: loading a vector from it would have to wait for LANES narrow stores. */
#if LANES == 1
#define GATHER(p, i) ((p)[i])
#elif LANES == 4
#define GATHER(p, i) ((vf)((p)[(i).s0], (p)[(i).s1], (p)[(i).s2], (p)[(i).s3]))
#else
#define GATHER_4(p, i, a, b, c, d) (p)[(i).a], (p)[(i).b], (p)[(i).c], (p)[(i).d]
#if LANES == 8
#define GATHER(p, i) ((vf)(GATHER_4(p, i, s0, s1, s2, s3), GATHER_4(p, i, s4, s5, s6, s7)))
#else
#define GATHER(p, i) ((vf)(GATHER_4(p, i, s0, s1, s2, s3), GATHER_4(p, i, s4, s5, s6, s7), \
                           GATHER_4(p, i, s8, s9, sa, sb), GATHER_4(p, i, sc, sd, se, sf)))
#endif
#endif

/* V_LOOKUP(low, high, i) returns, in each lane, element i of the 2 × LANES elements of `low` followed by `high`. It is
   defined only if the processor has an instruction for it, which is much faster than GATHER. */
#ifdef __has_builtin
#if LANES == 16 && defined(__AVX512F__) && __has_builtin(__builtin_ia32_vpermi2varps512)
typedef float v_table __attribute__((vector_size(64)));
typedef int v_places __attribute__((vector_size(64)));
#define V_LOOKUP(low, high, i) __builtin_astype(__builtin_ia32_vpermi2varps512( \
    __builtin_astype((low), v_table), __builtin_astype((i), v_places), __builtin_astype((high), v_table)), vf)
#elif LANES == 8 && defined(__AVX2__) && __has_builtin(__builtin_ia32_permvarsf256)
typedef float v_table __attribute__((vector_size(32)));
typedef int v_places __attribute__((vector_size(32)));
#define V_PERMUTED(v, i) __builtin_astype( \
    __builtin_ia32_permvarsf256(__builtin_astype((v), v_table), __builtin_astype((i), v_places)), vf)
#define V_LOOKUP(low, high, i) V_PICK(V_PERMUTED(low, i), V_PERMUTED(high, i), (i) >= LANES)
#endif
#endif
