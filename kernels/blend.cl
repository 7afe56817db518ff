/* The full-resolution pass over one band of rows. Built with PIXEL (stored sample type), SAMPLES (2 or 4, alpha
   last), WHITE (full scale) and INTEGER (1: round and saturate). Places are pixels of the region.

   A work item makes four pixels side by side: what is known of each is float4 or int4, their colours are float16, r,
   g, b and one value more of the first, then of the next. PoCL's compiler makes vectors of no more than what is
   written as vectors, and a processor waits less where there is more to do at a time. */

/* Of the cubic that layers are sampled with: Catmull-Rom's -1/2 loses a twentieth of fine texture's gradients over
   all fractions, this next to nothing; a ramp stays one to 0.03 px. */
#define BLEND_SLOPE (-2.0f / 3.0f)

#if SAMPLES > 2
#define BLEND_SAMPLES 16
#define BLEND_ALPHAS s37bf
#else
#define BLEND_SAMPLES 8
#define BLEND_ALPHAS s1357
#endif

typedef PIXEL_VECTOR(PIXEL, BLEND_SAMPLES) blend_pixels; /* four as stored */

/* One layer as a band needs it: 64 bytes, made by hugin_abflow/blend.py. */
typedef struct {
    int4 place;     /* of its stored rows: left, top, width, height */
    int2 way;       /* left, width of its field on the working grid */
    int rows, ways, gains; /* where it begins in `stored`, `ways` and `gains`; gains -1: no correction */
    int ring, turn; /* rows lie in a ring of so many, the first one there */
    int offsets;    /* where they begin in `offsets`; -1: none */
    int2 span;      /* left, width of its offsets on their grid */
    int unused[2];
} blend_layer;

/* pixel_samples of common.cl for four pixels: in OpenCL C no text says which samples go where for both. */
static inline float16 blend_colours(blend_pixels p) {
#if SAMPLES > 2
    return convert_float16(p);
#else
    return convert_float8(p).s0001222344456667;
#endif
}

static inline blend_pixels blend_stored(float16 v) {
#if SAMPLES > 2
    return PIXEL_VECTOR(convert_, PIXEL_VECTOR(PIXEL, 16))(v);
#else
    return PIXEL_VECTOR(convert_, PIXEL_VECTOR(PIXEL, 8))(v.s03478bcf);
#endif
}

/* What is known of four pixels, for each of their samples. */
#define BLEND_EACH(v) (v).s0000111122223333

/* Whether it is so for one of four pixels at least. */
static inline bool blend_some(int4 v) {
    return (v.x | v.y | v.z | v.w) != 0;
}

/* Where r, g or b is not 0. */
static inline int4 blend_any(float16 v) {
    const int16 set = v != 0.0f;
    return set.s048c | set.s159d | set.s26ae;
}

/* Which row of its ring a layer's row is. */
static inline int blend_turned(__global const blend_layer *layer, int row) {
    row += layer->turn;
    return row - (row >= layer->ring ? layer->ring : 0);
}

/* r, g, b in stored units and 1 for a valid pixel, else zeros. */
static inline float4 blend_tap(__global const pixel_stored *stored, __global const blend_layer *layer, int2 p) {
    const int4 place = layer->place;
    const int x = p.x - place.x, y = p.y - place.y;
    if (x < 0 || y < 0 || x >= place.z || y >= place.w)
        return (float4)(0.0f);
    const float4 c = pixel_samples(stored[layer->rows + blend_turned(layer, y) * place.z + x]);
    return c.w >= 0.5f * WHITE ? (float4)(c.xyz, 1.0f) : (float4)(0.0f);
}

/* Four pixels of a row as stored; handed on by its address, as charts are in common.cl. */
static inline void blend_four(__global const pixel_stored *p, blend_pixels *row) {
    *row = (blend_pixels)(p[0], p[1], p[2], p[3]);
}

/* blend_tap for p and the three pixels to its right. */
static inline float16 blend_taps(__global const pixel_stored *stored, __global const blend_layer *layer, int2 p) {
    const int4 place = layer->place;
    const int x = p.x - place.x, y = p.y - place.y;
    if (x < -3 || y < 0 || x >= place.z || y >= place.w)
        return (float16)(0.0f);
    if (x < 0 || x + 3 >= place.z)
        return (float16)(blend_tap(stored, layer, p), blend_tap(stored, layer, p + (int2)(1, 0)),
                         blend_tap(stored, layer, p + (int2)(2, 0)), blend_tap(stored, layer, p + (int2)(3, 0)));
    blend_pixels four;
    blend_four(stored + layer->rows + blend_turned(layer, y) * place.z + x, &four);
    float16 c = blend_colours(four);
    const int4 valid = c.s37bf >= 0.5f * WHITE;
    c.s37bf = (float4)(1.0f);
    return BLEND_EACH(valid) ? c : (float16)(0.0f);
}

/* Sample where taps may be missing or go across the canvas's border: bicubic if all are there, else bilinear over the
   valid ones, whose share is w. corner: the pixel up and left of the position, t: how far from there. */
static float4 blend_rim(__global const pixel_stored *stored, __global const blend_layer *layer, int2 corner, float2 t,
                        int4 border) {
    const float4 wx = cubic_taps(t.x, BLEND_SLOPE), wy = cubic_taps(t.y, BLEND_SLOPE);
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

/* Sample at position q. */
static inline float4 blend_sample(__global const pixel_stored *stored, __global const blend_layer *layer, float2 q,
                                  int4 border, int nearest) {
    int2 corner = floor_int2(nearest ? q : q - 0.5f);
    if (nearest)
        return grid_border(&corner, border) ? blend_tap(stored, layer, corner) : (float4)(0.0f);
    const float2 t = q - 0.5f - convert_float2(corner);
    const int4 place = layer->place;
    const int2 first = corner - 1 - place.xy;
    if (first.x >= 0 && first.y >= 0 && first.x + 3 < place.z && first.y + 3 < place.w) {
        /* nearly all samples: every tap is stored, no border rule is needed */
        blend_pixels r0, r1, r2, r3;
        const int row = blend_turned(layer, first.y), wide = place.z;
        const int rest = layer->ring - row, all = layer->ring * wide; /* rows until they begin anew */
        __global const pixel_stored *p = stored + layer->rows + row * wide + first.x;
        blend_four(p, &r0);
        blend_four(p + (rest > 1 ? wide : wide - all), &r1);
        blend_four(p + (rest > 2 ? 2 * wide : 2 * wide - all), &r2);
        blend_four(p + (rest > 3 ? 3 * wide : 3 * wide - all), &r3);
        const blend_pixels least = LEAST(LEAST(r0, r1), LEAST(r2, r3));
        const int4 valid = convert_float4(least.BLEND_ALPHAS) >= 0.5f * WHITE;
        if (valid.x & valid.y & valid.z & valid.w) {
            const float4 wx = cubic_taps(t.x, BLEND_SLOPE), wy = cubic_taps(t.y, BLEND_SLOPE);
            const float16 sums = wy.x * blend_colours(r0) + wy.y * blend_colours(r1) + wy.z * blend_colours(r2) +
                                 wy.w * blend_colours(r3);
            const float4 sum = wx.x * sums.s0123 + wx.y * sums.s4567 + wx.z * sums.s89ab + wx.w * sums.scdef;
            return (float4)(sum.xyz, 1.0f);
        }
    }
    return blend_rim(stored, layer, corner, t, border);
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
        const float4 a = from[LIMITED(upper - box.y, 0, box.w - 1) * box.z];
        const float4 v = a + t * (from[LIMITED(upper + 1 - box.y, 0, box.w - 1) * box.z] - a);
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

/* Which columns of a coarse line four positions lie between, and how far. */
typedef struct {
    int4 left, right;
    float4 t;
} blend_between;

/* The columns of a whole grid. */
static inline blend_between blend_columns(float4 q) {
    const float4 p = q - 0.5f;
    int4 left = convert_int4(p);
    left += p < convert_float4(left); /* true is -1 */
    const blend_between at = {left, left + 1, p - convert_float4(left)};
    return at;
}

/* The same in a line of the columns from span.x on, span.y of them. */
static inline blend_between blend_within(blend_between at, int2 span, int4 border) {
    at.left -= span.x;
    at.right -= span.x;
    if (border.z && span.y == border.x) {
        at.left += at.left < 0 ? border.x : 0;
        at.right -= at.right >= border.x ? border.x : 0;
    }
    at.left = LIMITED(at.left, 0, span.y - 1);
    at.right = LIMITED(at.right, 0, span.y - 1);
    return at;
}

/* Linear reading of a line of values. */
static inline float16 blend_read(__global const float4 *line, blend_between at) {
    const int4 l = at.left, r = at.right;
    const float16 a = (float16)(line[l.x], line[l.y], line[l.z], line[l.w]);
    const float16 b = (float16)(line[r.x], line[r.y], line[r.z], line[r.w]);
    return a + BLEND_EACH(at.t) * (b - a);
}

/* How four pixels are corrected: what odds are multiplied by, less 1, then what is added, for floats to the
   logarithms of exposure_scale; where there is something. */
typedef struct {
    float16 rise, offset;
    int4 some;
} blend_correction;

/* Where corrections of four pixels are read: arrays, columns, the row of gains and that of the band. */
typedef struct {
    __global const float4 *gains, *offsets;
    blend_between cell, column;
    int gain_row, row;
    int4 offset_border;
} blend_corrections;

static inline blend_correction blend_corrected(const blend_corrections *from, __global const blend_layer *layer) {
    blend_correction result = {(float16)(0.0f), (float16)(0.0f), (int4)(0)};
    if (layer->gains >= 0) {
        const float16 gain = blend_read(from->gains + layer->gains + from->gain_row, from->cell);
        result.rise = exponential16(gain) - 1.0f;
        result.some = blend_any(gain);
    }
    if (layer->offsets >= 0) {
        const float16 offset = blend_read(from->offsets + layer->offsets + from->row * layer->span.y,
                                         blend_within(from->column, layer->span, from->offset_border));
        result.offset = INTEGER ? WHITE * offset : exponential16(offset) - 1.0f;
        result.some |= blend_any(offset);
    }
    return result;
}

static inline float16 blend_correct(float16 c, blend_correction by, float shoulder) {
    c = exposure_raise16(c, by.rise, WHITE, shoulder);
    if (INTEGER)
        return c + by.offset;
    const float16 light = GREATEST(c, (float16)(0.0f)), v = c + (light + EXPOSURE_FLOOR) * by.offset;
    return v < 0.0f && c >= 0.0f ? (float16)(0.0f) : v;
}

/* atan2 of positive x; a few terms of the series do where angles are small, as they nearly always are. */
static inline float4 blend_angles(float4 y, float4 x) {
    const float4 t = y / x, t2 = t * t;
    const int4 small = x > 0.0f && t2 < 0.01f;
    const float4 angle = t * (1.0f - t2 * (1.0f / 3.0f - t2 * (0.2f - t2 * (1.0f / 7.0f))));
    if (!blend_some(!small))
        return angle;
    return small ? angle : atan2(y, x);
}

/* Where a layer is sampled for pixels at (px, py): the field's displacements d carried to full resolution.
   sl, cl, sp, cp: sine and cosine of the pixels' longitudes and latitude. */
static inline void blend_positions(float4 px, float py, float16 d, float2 scale, float4 lens, float4 sl, float4 cl,
                                   float sp, float cp, float4 *x, float4 *y) {
    const float4 dx = d.s048c, dy = d.s159d, dz = d.s26ae;
    if (lens.y == 0.0f) {
        *x = px + dx * scale.x;
        *y = py + dy * scale.y;
        return;
    }
    /* in the frame of p (east, north, up) the change of longitude is small, hence exact in float32 */
    const float4 east = cl * dx - sl * dy, out = cp + sl * dx + cl * dy;
    const float4 north = sp + dz, squared = east * east + out * out;
    const float4 level = root4(squared);
    *x = px + blend_angles(east, out) / lens.y;
    *y = py - blend_angles(north * cp - level * sp, level * cp + north * sp) / lens.w;
}

/* The fractions above which r, g, b are rounded up at canvas pixels (x, y) to (x + 3, y): uniform in 0..1, so that
   the mean of many rounded pixels is right. Steps of the golden ratio spread them evenly along a row, which halves
   the noise that is coarse enough to be seen; where rows begin is mixed from all bits of y and channel. */
static inline float16 blend_thresholds(int x, int y) {
    uint4 h = (uint)y * 4u + (uint4)(0, 1, 2, 3);
    h = (h ^ (h >> 16)) * 0x85ebca6bu;
    h = (h ^ (h >> 13)) * 0xc2b2ae35u;
    h ^= h >> 16;
    const uint16 across = (uint16)((uint4)x, (uint4)(x + 1), (uint4)(x + 2), (uint4)(x + 3)) * 0x9e3779b9u;
    return (convert_float16((h.s0123012301230123 + across) >> 16) + 0.5f) / 65536.0f;
}

/* Whole numbers from 0 to full scale, rounded to nearest, or by dither where a threshold says so. What is whole
   but for the rounding of float32 stays as it is. */
static inline float16 blend_round(float16 v, float16 thresholds, int16 dithered) {
    v = v < 0.0f ? 0.0f : v > WHITE ? WHITE : v;
    const float16 nearest = (v + 8388608.0f) - 8388608.0f, off = v - nearest; /* 2^23 leaves no bits below 1 */
    const float16 below = convert_float16(convert_int16(v));
    const float16 spread = v - below > thresholds ? below + 1.0f : below;
    return dithered ? (off <= 2e-7f * WHITE && off >= -2e-7f * WHITE ? nearest : spread) : nearest;
}

/* One band of the panorama: each pixel is the mean of the layers that cover it, sampled where their fields
   say and weighted as they say. The sum is of differences from a reference, the first layer's own pixel, so
   that equal colours stay equal to the bit; where nothing else is known, that is the result. */
__kernel void blend_band(
    __global const pixel_stored *stored, /* a ring of rows for each layer: (ring, width) */
    __global const blend_layer *layers, int count, /* those that the band may touch */
    __global const float4 *ways,         /* per layer, (band.w, way.y): displacement, weight, from blend_rows */
    __global const float4 *gains,        /* per corrected layer, (band.w, gain_border.x) */
    __global const float4 *offsets,      /* per layer with offsets, (band.w, span.y) */
    __global const float2 *columns,      /* (band.z) sine and cosine of longitude; plane: not used */
    __global const float2 *lines,        /* (band.w) sine and cosine of latitude; plane: not used */
    int4 border, float4 lens,            /* full-resolution grid of the region */
    int4 field_border, int4 gain_border, int4 offset_border, /* working grid; colour grid; grid of offsets */
    int4 band,                           /* its place: left, top, width, height; run size: fours of columns, rows */
    int2 origin,                         /* the region's place on the canvas */
    float shoulder,                      /* of the exposure scale */
    int nearest,                         /* 1: nearest-neighbour sampling */
    float share,                         /* of all weight, below which a layer is hidden */
    __global pixel_stored *out)          /* (band.w, band.z) */
{
    const int x = 4 * get_global_id(0), y = get_global_id(1);
    if (x >= band.z || y >= band.w)
        return;
    const int2 place = (int2)(x + band.x, y + band.y);
    const float4 px = convert_float4(place.x + (int4)(0, 1, 2, 3)) + 0.5f;
    const float py = place.y + 0.5f;
    const float2 scale = (float2)((float)border.x / field_border.x, (float)border.y / field_border.y);
    const blend_corrections corrections = {
        gains, offsets,
        blend_within(blend_columns(px * ((float)gain_border.x / border.x)), (int2)(0, gain_border.x), gain_border),
        blend_columns(px * ((float)offset_border.x / border.x)), y * gain_border.x, y, offset_border};

    int first = count;
    blend_correction correction, first_correction;
    int4 known = (int4)(0), several = (int4)(0), corrected = (int4)(0);
    float16 reference = (float16)(0.0f);
    for (int k = 0; k < count && blend_some(!several); ++k) {
        float16 own = blend_taps(stored, layers + k, place);
        const int4 seen = own.s37bf != 0.0f, fresh = seen & ~known;
        several |= seen & known;
        known |= seen;
        if (!blend_some(fresh))
            continue;
        correction = blend_corrected(&corrections, layers + k);
        if (first == count) {
            first = k;
            first_correction = correction;
        }
        own = blend_correct(own, correction, shoulder);
        corrected |= fresh & correction.some;
        reference = BLEND_EACH(fresh) ? own : reference;
    }
    float16 sum = (float16)(0.0f);
    if (blend_some(several)) {
        const blend_between column = blend_columns(px / scale.x);
        float4 sl = (float4)(0.0f), cl = sl;
        float sp = 0.0f, cp = 0.0f;
        if (lens.y != 0.0f) {
            const int last = band.z - 1;
            const float8 turns = (float8)(columns[x], columns[LEAST(x + 1, last)], columns[LEAST(x + 2, last)],
                                          columns[LEAST(x + 3, last)]);
            sl = turns.even;
            cl = turns.odd;
            sp = lines[y].x;
            cp = lines[y].y;
        }
        float4 hidden = (float4)(0.0f);
        int4 open = several;
        /* a second time with all layers, if most of what is seen lies outside its layer */
        for (int round = 0; round < 2 && blend_some(open); ++round) {
            float4 total = (float4)(0.0f);
            float16 all = (float16)(0.0f);
            for (int k = first; k < count; ++k) {
                float16 c = blend_taps(stored, layers + k, place);
                int4 seen = open & (c.s37bf != 0.0f);
                if (!blend_some(seen))
                    continue;
                __global const float4 *line = ways + layers[k].ways + y * layers[k].way.y;
                const float16 way = blend_read(line, blend_within(column, layers[k].way, field_border));
                float4 w = way.s37bf + hidden;
                seen &= w > 0.0f;
                if (!blend_some(seen))
                    continue;
                w = seen ? w : 0.0f;
                total += w;
                const int4 moved = seen & blend_any(way);
                if (blend_some(moved)) {
                    float4 qx, qy;
                    blend_positions(px, py, way, scale, lens, sl, cl, sp, cp, &qx, &qy);
                    if (moved.x)
                        c.s0123 = blend_sample(stored, layers + k, (float2)(qx.x, qy.x), border, nearest);
                    if (moved.y)
                        c.s4567 = blend_sample(stored, layers + k, (float2)(qx.y, qy.y), border, nearest);
                    if (moved.z)
                        c.s89ab = blend_sample(stored, layers + k, (float2)(qx.z, qy.z), border, nearest);
                    if (moved.w)
                        c.scdef = blend_sample(stored, layers + k, (float2)(qx.w, qy.w), border, nearest);
                }
                /* a sample that falls outside its layer counts smoothly less */
                w *= c.s37bf * c.s37bf;
                correction = k == first ? first_correction : blend_corrected(&corrections, layers + k);
                c = blend_correct(c, correction, shoulder);
                corrected |= correction.some & (w > 0.0f);
                float16 part = (c - reference) * BLEND_EACH(w);
                part.s37bf = w;
                all += part;
            }
            sum = BLEND_EACH(open) ? all : sum;
            open &= !(all.s37bf >= 0.5f * total);
            hidden = share * total;
        }
    }
    const int4 mixed = sum.s37bf > 1e-30f;
    float16 v = BLEND_EACH(mixed) ? reference + sum / BLEND_EACH(sum.s37bf) : reference;
    v.s37bf = known ? (float4)(WHITE) : (float4)(0.0f);
    if (INTEGER)
        v = blend_round(v, blend_thresholds(place.x + origin.x, place.y + origin.y), BLEND_EACH(corrected));
    const blend_pixels made = blend_stored(v);
    __global pixel_stored *target = out + y * band.z + x;
    target[0] = made.lo.lo;
    if (x + 1 < band.z)
        target[1] = made.lo.hi;
    if (x + 2 < band.z)
        target[2] = made.hi.lo;
    if (x + 3 < band.z)
        target[3] = made.hi.hi;
}
