/* The full-resolution pass over one band of rows. Built with PIXEL (stored sample type), SAMPLES (2 or 4, alpha
   last), WHITE (full scale) and INTEGER (1: round and saturate). Places are pixels of the region. */

#define BLEND_JOIN(type, n) type##n
#define BLEND_VECTOR(type, n) BLEND_JOIN(type, n)
/* Of the cubic that layers are sampled with: Catmull-Rom's -1/2 loses a twentieth of fine texture's gradients over
   all fractions, this next to nothing; a ramp stays one to 0.03 px. */
#define BLEND_SLOPE (-2.0f / 3.0f)

typedef BLEND_VECTOR(PIXEL, SAMPLES) blend_pixel; /* as stored */

/* One layer as a band needs it: 64 bytes, made by hugin_abflow/blend.py. */
typedef struct {
    int4 place;     /* of its stored rows: left, top, width, height */
    int2 way, gain; /* left, width of its field, on the working grid, and of its gain, on the colour grid */
    int rows, ways, gains; /* where it begins in `stored`, `ways` and `gains`; gains -1: no correction */
    int ring, turn; /* rows lie in a ring of so many, the first one there */
    int unused[3];
} blend_layer;

/* r, g, b, alpha in stored units. */
static inline float4 blend_samples(blend_pixel p) {
#if SAMPLES > 2
    return convert_float4(p);
#else
    return convert_float2(p).xxxy;
#endif
}

/* Where a layer's stored row lies; its rows go round. */
static inline __global const blend_pixel *blend_line(__global const blend_pixel *stored,
                                                     __global const blend_layer *layer, int row) {
    row += layer->turn;
    row -= row >= layer->ring ? layer->ring : 0;
    return stored + layer->rows + row * layer->place.z;
}

/* r, g, b in stored units and 1 for a valid pixel, else zeros. */
static inline float4 blend_tap(__global const blend_pixel *stored, __global const blend_layer *layer, int2 p) {
    const int4 place = layer->place;
    const int x = p.x - place.x, y = p.y - place.y;
    if (x < 0 || y < 0 || x >= place.z || y >= place.w)
        return (float4)(0.0f);
    const float4 c = blend_samples(blend_line(stored, layer, y)[x]);
    return c.w >= 0.5f * WHITE ? (float4)(c.xyz, 1.0f) : (float4)(0.0f);
}

static inline float4 blend_row(__global const blend_pixel *p, float4 weights, float4 *least) {
    const float4 a = blend_samples(p[0]), b = blend_samples(p[1]), c = blend_samples(p[2]), d = blend_samples(p[3]);
    const float4 ab = a < b ? a : b, cd = c < d ? c : d, low = ab < cd ? ab : cd;
    *least = low < *least ? low : *least;
    return weights.x * a + weights.y * b + weights.z * c + weights.w * d;
}

/* Bicubic sample at position q; next to the mask's rim bilinear over the valid taps, whose share is w. */
static float4 blend_sample(__global const blend_pixel *stored, __global const blend_layer *layer, float2 q,
                           int4 border, int nearest) {
    int2 corner = floor_int2(nearest ? q : q - 0.5f);
    if (nearest)
        return grid_border(&corner, border) ? blend_tap(stored, layer, corner) : (float4)(0.0f);
    const float2 t = q - 0.5f - convert_float2(corner);
    const float4 wx = cubic_taps(t.x, BLEND_SLOPE), wy = cubic_taps(t.y, BLEND_SLOPE);
    const int4 place = layer->place;
    const int2 first = corner - 1 - place.xy;
    if (first.x >= 0 && first.y >= 0 && first.x + 3 < place.z && first.y + 3 < place.w) {
        /* nearly all samples: every tap is stored, no border rule is needed */
        float4 least = (float4)(WHITE);
        float4 sum = wy.x * blend_row(blend_line(stored, layer, first.y) + first.x, wx, &least);
        sum += wy.y * blend_row(blend_line(stored, layer, first.y + 1) + first.x, wx, &least);
        sum += wy.z * blend_row(blend_line(stored, layer, first.y + 2) + first.x, wx, &least);
        sum += wy.w * blend_row(blend_line(stored, layer, first.y + 3) + first.x, wx, &least);
        if (least.w >= 0.5f * WHITE)
            return (float4)(sum.xyz, 1.0f);
    }
    const float ax[4] = {wx.x, wx.y, wx.z, wx.w}, ay[4] = {wy.x, wy.y, wy.z, wy.w};
    float4 cubic = (float4)(0.0f), linear = (float4)(0.0f);
    int missing = 0;
    for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i) {
            int2 p = corner + (int2)(i - 1, j - 1);
            const float4 c = grid_border(&p, border) ? blend_tap(stored, layer, p) : (float4)(0.0f);
            missing += c.w == 0.0f;
            cubic += ax[i] * ay[j] * c;
            if (i > 0 && i < 3 && j > 0 && j < 3)
                linear += (i == 1 ? 1.0f - t.x : t.x) * (j == 1 ? 1.0f - t.y : t.y) * c;
        }
    if (missing == 0)
        return (float4)(cubic.xyz, 1.0f);
    return linear.w > 0.0f ? (float4)(linear.xyz / linear.w, linear.w) : (float4)(0.0f);
}

static inline int blend_clamp(int i, int size) {
    return i < 0 ? 0 : i < size ? i : size - 1;
}

/* Values of coarse arrays at the heights of a band's rows, linear between their rows; beyond an array, its rim.
   Weights (w) that are less than a share of their sum, which nobody sees, become negative. */
__kernel void blend_rows(__global const float4 *values, /* arrays one after the other: (box.w, box.z) each */
                         __global const int8 *arrays,   /* (count) box on the coarse grid; begin in values, rows */
                         int count,
                         int2 size,                  /* columns of the coarse grid, rows of the band: run size */
                         int top, float scale,       /* the band's first row; its rows per row of the grid */
                         float share,                /* below which weights are hidden; 0: none */
                         __global float4 *rows)      /* per array, (size.y, box.z) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= size.x || y >= size.y)
        return;
    const float q = (top + y + 0.5f) / scale - 0.5f;
    int upper = (int)q;
    upper -= q < upper;
    const float t = q - upper;
    float total = 0.0f;
    for (int k = 0; k < count; ++k) {
        const int4 box = arrays[k].lo;
        const int column = x - box.x;
        if (column < 0 || column >= box.z)
            continue;
        __global const float4 *from = values + arrays[k].s4 + column;
        const float4 a = from[blend_clamp(upper - box.y, box.w) * box.z];
        const float4 v = a + t * (from[blend_clamp(upper + 1 - box.y, box.w) * box.z] - a);
        rows[arrays[k].s5 + y * box.z + column] = v;
        total += v.w > 0.0f ? v.w : 0.0f;
    }
    const float least = share * total;
    for (int k = 0; k < count && least > 0.0f; ++k) {
        const int column = x - arrays[k].s0;
        if (column < 0 || column >= arrays[k].s2)
            continue;
        __global float *w = (__global float *)(rows + arrays[k].s5 + y * arrays[k].s2 + column) + 3;
        *w -= *w > least ? least * least / *w : least; /* hardly less where much is left */
    }
}

/* Linear reading of a line of such values, the grid's columns from span.x on, span.y of them, at q. */
static inline float4 blend_read(__global const float4 *line, int2 span, float q, int4 border) {
    const float p = q - 0.5f - span.x;
    int left = (int)p;
    left -= p < left;
    const float t = p - left;
    int right = left + 1;
    if (border.z && span.y == border.x) {
        left += left < 0 ? border.x : 0;
        right -= right >= border.x ? border.x : 0;
    }
    const float4 a = line[blend_clamp(left, span.y)], b = line[blend_clamp(right, span.y)];
    return a + t * (b - a);
}

static inline bool blend_any(float3 v) {
    return v.x != 0.0f || v.y != 0.0f || v.z != 0.0f;
}

/* A layer's gain at column q of the colour grid. */
static inline float3 blend_gain(__global const float4 *gains, __global const blend_layer *layer, int y, float q,
                                int4 border) {
    if (layer->gains < 0)
        return (float3)(0.0f);
    return blend_read(gains + layer->gains + y * layer->gain.y, layer->gain, q, border).xyz;
}

/* Smooth exposure correction of a colour in stored units. */
static inline float3 blend_correct(float3 c, float3 gain, float shoulder) {
    return blend_any(gain) ? exposure_raise(c, exponential(gain.xyzz).xyz - 1.0f, WHITE, shoulder) : c;
}

/* atan2 of a positive x; a few terms of the series do where the angle is small, as it nearly always is. */
static inline float blend_angle(float y, float x) {
    const float t = y / x, t2 = t * t;
    if (x > 0.0f && t2 < 0.01f)
        return t * (1.0f - t2 * (1.0f / 3.0f - t2 * (0.2f - t2 / 7.0f)));
    return atan2(y, x);
}

/* Where a layer is sampled for the pixel at p: the field's displacement d carried to full resolution.
   turn: sine and cosine of the pixel's longitude and latitude. */
static inline float2 blend_position(float2 p, float3 d, float2 scale, float4 lens, float4 turn) {
    if (lens.y == 0.0f)
        return p + d.xy * scale;
    /* in the frame of p (east, north, up) the change of longitude is small, hence exact in float32 */
    const float sl = turn.x, cl = turn.y, sp = turn.z, cp = turn.w;
    const float east = cl * d.x - sl * d.y, out = cp + sl * d.x + cl * d.y;
    const float north = sp + d.z, level = ROOT(east * east + out * out);
    return (float2)(p.x + blend_angle(east, out) / lens.y,
                    p.y - blend_angle(north * cp - level * sp, level * cp + north * sp) / lens.w);
}

/* The fractions above which r, g, b are rounded up at canvas pixel (x, y): uniform in 0..1, so that the mean of
   many rounded pixels is right. Steps of the golden ratio spread them evenly along a row, which halves the noise
   that is coarse enough to be seen; where rows begin is mixed from all bits of y and channel. */
static inline float4 blend_thresholds(int x, int y) {
    uint4 h = (uint)y * 4u + (uint4)(0, 1, 2, 3);
    h = (h ^ (h >> 16)) * 0x85ebca6bu;
    h = (h ^ (h >> 13)) * 0xc2b2ae35u;
    h ^= h >> 16;
    return (convert_float4((h + (uint)x * 0x9e3779b9u) >> 16) + 0.5f) / 65536.0f;
}

/* Whole numbers from 0 to full scale, rounded to nearest, or by dither where a threshold says so. What is whole
   but for the rounding of float32 stays as it is. */
static inline float4 blend_round(float4 v, float4 thresholds, int dithered) {
    v = v < 0.0f ? 0.0f : v > WHITE ? WHITE : v;
    const float4 nearest = (v + 8388608.0f) - 8388608.0f, off = v - nearest; /* 2^23 leaves no bits below 1 */
    const float4 below = convert_float4(convert_int4(v));
    const float4 spread = v - below > thresholds ? below + 1.0f : below;
    return dithered ? (off <= 2e-7f * WHITE && off >= -2e-7f * WHITE ? nearest : spread) : nearest;
}

/* One band of the panorama: each pixel is the mean of the layers that cover it, sampled where their fields
   say and weighted as they say. The sum is of differences from a reference, the first layer's own pixel, so
   that equal colours stay equal to the bit; where nothing else is known, that is the result. */
__kernel void blend_band(
    __global const blend_pixel *stored, /* a ring of rows for each layer: (ring, width) */
    __global const blend_layer *layers, int count, /* those that the band may touch */
    __global const float4 *ways,         /* per layer, (band.w, way.y): displacement, weight, from blend_rows */
    __global const float4 *gains,        /* per corrected layer, (band.w, gain.y) */
    __global const float2 *columns,      /* (band.z) sine and cosine of longitude; plane: not used */
    __global const float2 *lines,        /* (band.w) sine and cosine of latitude; plane: not used */
    int4 border, float4 lens,            /* full-resolution grid of the region */
    int4 field_border, int4 gain_border, /* working grid; colour grid */
    int4 band,                           /* the band's place: left, top, run size */
    int2 origin,                         /* the region's place on the canvas */
    float shoulder,                      /* of the exposure scale */
    int nearest,                         /* 1: nearest-neighbour sampling */
    float share,                         /* of all weight, below which a layer is hidden */
    __global blend_pixel *out)           /* (band.w, band.z) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= band.z || y >= band.w)
        return;
    const int2 place = (int2)(x + band.x, y + band.y);
    const float2 p = convert_float2(place) + 0.5f;
    const float2 scale = (float2)((float)border.x / field_border.x, (float)border.y / field_border.y);
    const float cell = p.x * ((float)gain_border.x / border.x);

    int first = 0, several = 0;
    float4 reference = (float4)(0.0f);
    for (int k = 0; k < count && !several; ++k) {
        const float4 own = blend_tap(stored, layers + k, place);
        if (own.w == 0.0f)
            continue;
        several = reference.w != 0.0f;
        if (!several) {
            first = k;
            reference = own;
        }
    }
    int corrected = 0;
    if (reference.w != 0.0f) {
        const float3 gain = blend_gain(gains, layers + first, y, cell, gain_border);
        reference.xyz = blend_correct(reference.xyz, gain, shoulder);
        corrected = blend_any(gain);
    }
    float4 sum = (float4)(0.0f);
    if (several) {
        const float4 turn = lens.y == 0.0f ? (float4)(0.0f) : (float4)(columns[x], lines[y]);
        float hidden = 0.0f;
        /* a second time with all layers, if most of what is seen lies outside its layer */
        for (int round = 0; round < 2; ++round) {
            float total = 0.0f;
            sum = (float4)(0.0f);
            for (int k = first; k < count; ++k) {
                float4 c = blend_tap(stored, layers + k, place);
                if (c.w == 0.0f)
                    continue;
                __global const float4 *line = ways + layers[k].ways + y * layers[k].way.y;
                const float4 way = blend_read(line, layers[k].way, p.x / scale.x, field_border);
                float w = way.w + hidden;
                if (w <= 0.0f)
                    continue;
                total += w;
                if (blend_any(way.xyz))
                    c = blend_sample(stored, layers + k, blend_position(p, way.xyz, scale, lens, turn), border,
                                     nearest);
                /* a sample that falls outside its layer counts smoothly less */
                w *= c.w * c.w;
                if (w <= 0.0f)
                    continue;
                const float3 gain = blend_gain(gains, layers + k, y, cell, gain_border);
                sum += (float4)((blend_correct(c.xyz, gain, shoulder) - reference.xyz) * w, w);
                corrected |= blend_any(gain);
            }
            if (sum.w >= 0.5f * total)
                break;
            hidden = share * total;
        }
    }
    const float3 colour = sum.w > 1e-30f ? reference.xyz + sum.xyz / sum.w : reference.xyz;
    float4 v = (float4)(colour, reference.w * WHITE);
    if (INTEGER)
        v = blend_round(v, blend_thresholds(place.x + origin.x, place.y + origin.y), corrected);
#if SAMPLES > 2
    out[y * band.z + x] = (blend_pixel)((PIXEL)v.x, (PIXEL)v.y, (PIXEL)v.z, (PIXEL)v.w);
#else
    out[y * band.z + x] = (blend_pixel)((PIXEL)v.x, (PIXEL)v.w);
#endif
}
