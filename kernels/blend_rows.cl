/* Stored rows of layers, read PIXELS (2 or 4) pixels at a time; in front of blend.cl.

   What is known of each pixel is blend_real or blend_int, their colours are blend_samples, r, g, b and one value more
   of the first, then of the next. PoCL's compiler makes vectors of no more than what is written as vectors. */

/* With 4 pixels vectors are longer than some processors'. Clang warns of such arguments, which functions that were
   compiled for others would not find: ours are compiled together. Compilers for other devices may not know of it. */
#ifdef __has_warning
#if __has_warning("-Wpsabi")
#pragma clang diagnostic ignored "-Wpsabi"
#endif
#endif

/* PoCL's own functions that convert 16 numbers are compiled for AVX-512, and kernels may be compiled for shorter
   vectors (pocl.py), which are passed in another way. So its compiler converts these itself, which also saves calls. */
#ifdef POCL_DEVICE_ADDRESS_BITS
#undef convert_float16
#undef convert_int16
#undef convert_uchar16
#undef convert_ushort16
#define convert_float16(v) __builtin_convertvector(v, float16)
#define convert_int16(v) __builtin_convertvector(v, int16)
#define convert_uchar16(v) __builtin_convertvector(v, uchar16)
#define convert_ushort16(v) __builtin_convertvector(v, ushort16)
#endif

#if PIXELS == 4
#define BLEND_SAMPLES 16
#define BLEND_EACH(v) (v).s0000111122223333 /* what is known of pixels, for each of their samples */
#define BLEND_LIST(each) each(0, x), each(1, y), each(2, z), each(3, w)
#define BLEND_SOME(v) (((v).x | (v).y | (v).z | (v).w) != 0) /* whether it is so for one pixel at least */
#define REDS s048c
#define GREENS s159d
#define BLUES s26ae
#define FOURTHS s37bf
#define BLEND_SPREAD s0001222344456667 /* grey and alpha as r, g, b, alpha, and back */
#define BLEND_PACKED s03478bcf
EXPONENTIAL(16)
EXPOSURE_RAISE(16)
#else
#define BLEND_SAMPLES 8
#define BLEND_EACH(v) (v).s00001111
#define BLEND_LIST(each) each(0, x), each(1, y)
#define BLEND_SOME(v) (((v).x | (v).y) != 0)
#define REDS s04
#define GREENS s15
#define BLUES s26
#define FOURTHS s37
#define BLEND_SPREAD s00012223
#define BLEND_PACKED s0347
EXPONENTIAL(8)
EXPOSURE_RAISE(8)
#endif

#if SAMPLES > 2
#define BLEND_TWO 8 /* stored samples of two pixels, of four, of PIXELS */
#define BLEND_FOUR 16
#define BLEND_ALPHA w /* of one pixel, of four */
#define BLEND_ALPHAS s37bf
#else
#define BLEND_TWO 4
#define BLEND_FOUR 8
#define BLEND_ALPHA y
#define BLEND_ALPHAS s1357
#endif
#if PIXELS == 4
#define BLEND_STORED BLEND_FOUR
#else
#define BLEND_STORED BLEND_TWO
#endif

/* Alpha from which on a pixel is the layer's, in stored units; there is nothing in between, as on the working grid. */
#define BLEND_VALID (0.5f * WHITE)

/* For what PoCL's compiler would leave as calls: around these all that is in vector registers is saved, and what is
   handed on by its address lies in memory, for each work item of a group. What is hardly ever needed stays a call. */
#define BLEND_INLINE static inline __attribute__((always_inline))

typedef PIXEL_VECTOR(float, PIXELS) blend_real;
typedef PIXEL_VECTOR(int, PIXELS) blend_int;
typedef PIXEL_VECTOR(float, BLEND_SAMPLES) blend_samples;
typedef PIXEL_VECTOR(int, BLEND_SAMPLES) blend_marks;
typedef PIXEL_VECTOR(PIXEL, BLEND_TWO) blend_two;
typedef PIXEL_VECTOR(PIXEL, BLEND_FOUR) blend_four;
typedef PIXEL_VECTOR(PIXEL, BLEND_STORED) blend_pixels;
#define BLEND_REALS PIXEL_VECTOR(convert_, PIXEL_VECTOR(float, PIXELS))
#define BLEND_INTS PIXEL_VECTOR(convert_, PIXEL_VECTOR(int, PIXELS))
#define BLEND_FLOATS PIXEL_VECTOR(convert_, PIXEL_VECTOR(float, BLEND_SAMPLES))
#define BLEND_EXPONENTIAL PIXEL_VECTOR(exponential, BLEND_SAMPLES)
#define BLEND_RAISE PIXEL_VECTOR(exposure_raise, BLEND_SAMPLES)

/* 0, 1 and so on. */
#define BLEND_NUMBER(n, i) n
#define BLEND_COUNT ((blend_int)(BLEND_LIST(BLEND_NUMBER)))

/* Between which pixels of a grid PIXELS positions lie along one axis, and how far. */
typedef struct {
    blend_int left, right;
    blend_real t;
} blend_between;

static inline blend_between blend_split(blend_real q) {
    const blend_real p = q - 0.5f;
    blend_int left = BLEND_INTS(p);
    left += p < BLEND_REALS(left); /* true is -1 */
    return (blend_between){left, left + 1, p - BLEND_REALS(left)};
}

/* One layer as a band needs it: 96 bytes, made by hugin_abflow/blend.py. */
typedef struct {
    int4 place;                 /* of its stored rows: left, top, width, height */
    int4 field, gain, offset;   /* of the rows at hand of its field, gains and offsets, each on its grid */
    int fields, gains, offsets; /* where these begin; of gains and offsets -1: none */
    int ring, turn, unused;     /* its stored rows are a ring of so many; the first one there */
    long rows;                  /* where they begin: there may be more than 2^31 pixels */
} blend_layer;

/* pixel_samples for two pixels: in OpenCL C no text says which samples go where for both. */
static inline float8 blend_pair(blend_two p) {
#if SAMPLES > 2
    return convert_float8(p);
#else
    return convert_float4(p).s00012223;
#endif
}

/* The same for PIXELS, and back. */
static inline blend_samples blend_colours(blend_pixels p) {
#if SAMPLES > 2
    return BLEND_FLOATS(p);
#else
    return PIXEL_VECTOR(convert_, PIXEL_VECTOR(float, BLEND_STORED))(p).BLEND_SPREAD;
#endif
}

static inline blend_pixels blend_stored(blend_samples v) {
#if SAMPLES > 2
    return PIXEL_VECTOR(convert_, PIXEL_VECTOR(PIXEL, BLEND_STORED))(v);
#else
    return PIXEL_VECTOR(convert_, PIXEL_VECTOR(PIXEL, BLEND_STORED))(v.BLEND_PACKED);
#endif
}

/* Which row of its ring a layer's row is. */
static inline int blend_turned(__global const blend_layer *layer, int row) {
    row += layer->turn;
    return row - (row >= layer->ring ? layer->ring : 0);
}

/* Where it lies. */
static inline __global const pixel_stored *blend_line(__global const pixel_stored *stored,
                                                     __global const blend_layer *layer, int row) {
    return stored + layer->rows + (long)blend_turned(layer, row) * layer->place.z;
}

/* r, g, b in stored units and 1 for a valid pixel, else zeros. */
static inline float4 blend_tap(__global const pixel_stored *stored, __global const blend_layer *layer, int2 p) {
    const int4 place = layer->place;
    const int x = p.x - place.x, y = p.y - place.y;
    if (x < 0 || y < 0 || x >= place.z || y >= place.w)
        return (float4)(0.0f);
    const float4 c = pixel_samples(blend_line(stored, layer, y)[x]);
    return c.w >= BLEND_VALID ? (float4)(c.xyz, 1.0f) : (float4)(0.0f);
}

/* PIXELS stored pixels side by side. */
static inline blend_pixels blend_run(__global const pixel_stored *first) {
#define BLEND_NEXT(n, i) first[n]
    return (blend_pixels)(BLEND_LIST(BLEND_NEXT));
}

/* blend_tap for p and the pixels to its right. */
BLEND_INLINE blend_samples blend_taps(__global const pixel_stored *stored, __global const blend_layer *layer, int2 p) {
    const int4 place = layer->place;
    const int x = p.x - place.x, y = p.y - place.y;
    if (x <= -PIXELS || y < 0 || x >= place.z || y >= place.w)
        return (blend_samples)(0.0f);
#define BLEND_TAP(n, i) blend_tap(stored, layer, p + (int2)(n, 0))
    if (x < 0 || x + PIXELS > place.z)
        return (blend_samples)(BLEND_LIST(BLEND_TAP));
    blend_samples c = blend_colours(blend_run(blend_line(stored, layer, y) + x));
    const blend_int valid = c.FOURTHS >= BLEND_VALID;
    c.FOURTHS = (blend_real)(1.0f);
    return BLEND_EACH(valid) ? c : (blend_samples)(0.0f);
}

/* Where blend_taps finds valid pixels. */
static inline blend_int blend_valid(__global const pixel_stored *stored, __global const blend_layer *layer, int2 p) {
    const int4 place = layer->place;
    const int x = p.x - place.x, y = p.y - place.y;
    if (x <= -PIXELS || y < 0 || x >= place.z || y >= place.w)
        return (blend_int)(0);
    __global const pixel_stored *first = blend_line(stored, layer, y) + x;
#define BLEND_KNOWN(n, i) (x + n >= 0 && x + n < place.z ? first[n].BLEND_ALPHA : (PIXEL)0)
#define BLEND_INSIDE(n, i) first[n].BLEND_ALPHA
    if (x < 0 || x + PIXELS > place.z)
        return (blend_real)(BLEND_LIST(BLEND_KNOWN)) >= BLEND_VALID;
    return (blend_real)(BLEND_LIST(BLEND_INSIDE)) >= BLEND_VALID;
}
