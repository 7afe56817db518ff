/* Layers between their pixels; in front of blend.cl. */

/* Of the cubic that layers are sampled with: Catmull-Rom's -1/2 loses a twentieth of fine texture's gradients over
   all fractions, this next to nothing; a ramp stays one to 0.03 px. */
#define BLEND_SLOPE (-2.0f / 3.0f)
/* Beside a step it swings back by a share of that. Beside a lamp this is more light than there is: a black rim. So
   floats, which no range limits, go no farther below the least tap than by half of it, integers, which are coded, by a
   quarter, which is as much light; ordinary texture does not anyway. */
#define BLEND_LIT(v, least)                                                                                        \
    (INTEGER ? GREATEST(v, 0.75f * (least)) : GREATEST(v, (least) - 0.5f * MAGNITUDE(least)))

/* What is kept for PIXELS sets of four taps, or of their weights, is blend_samples too. */
#define FIRSTS REDS
#define SECONDS GREENS
#define THIRDS BLUES

/* Whether a layer holds four rows of so many columns from `first` on, a place in it. */
static inline int blend_sample_stored(__global const blend_layer *layer, int2 first, int columns) {
    const int4 place = layer->place;
    return first.x >= 0 && first.y >= 0 && first.x + columns <= place.z && first.y + 4 <= place.w;
}

/* Those rows; their ring may begin anew among them. */
typedef struct {
    __global const pixel_stored *a, *b, *c, *d;
} blend_sample_lines;

static inline blend_sample_lines blend_sample_rows(__global const pixel_stored *stored,
                                                   __global const blend_layer *layer, int2 first) {
    const long wide = layer->place.z, all = layer->ring * wide;
    const int rest = layer->ring - blend_turned(layer, first.y); /* rows until they begin anew */
    __global const pixel_stored *p = blend_line(stored, layer, first.y) + first.x;
    return (blend_sample_lines){p, p + (rest > 1 ? wide : wide - all), p + (rest > 2 ? 2 * wide : 2 * wide - all),
                                p + (rest > 3 ? 3 * wide : 3 * wide - all)};
}

/* Four pixels of a row as stored; handed on by its address, as charts are in common.cl. */
static inline void blend_row(__global const pixel_stored *p, blend_four *row) {
    *row = (blend_four)(p[0], p[1], p[2], p[3]);
}

/* Sample where taps may be missing or go across the canvas's border: bicubic if all are there, else bilinear over the
   valid ones, whose share is w. corner: the pixel up and left of the position, t: how far from there. */
static float4 blend_rim(__global const pixel_stored *stored, __global const blend_layer *layer, int2 corner, float2 t,
                        int4 border) {
    const float4 wx = cubic_taps(t.x, BLEND_SLOPE), wy = cubic_taps(t.y, BLEND_SLOPE);
    const float ax[4] = {wx.x, wx.y, wx.z, wx.w}, ay[4] = {wy.x, wy.y, wy.z, wy.w};
    float4 cubic = (float4)(0.0f), linear = (float4)(0.0f), least = (float4)(FLT_MAX);
    int missing = 0;
    for (int j = 0; j < 4; ++j)
        for (int i = 0; i < 4; ++i) {
            int2 p = corner + (int2)(i - 1, j - 1);
            const float4 c = grid_border(&p, border) ? blend_tap(stored, layer, p) : (float4)(0.0f);
            missing += c.w == 0.0f;
            cubic += ax[i] * ay[j] * c;
            least = LEAST(least, c);
            if (i > 0 && i < 3 && j > 0 && j < 3)
                linear += (i == 1 ? 1.0f - t.x : t.x) * (j == 1 ? 1.0f - t.y : t.y) * c;
        }
    if (missing == 0)
        return (float4)(BLEND_LIT(cubic, least).xyz, 1.0f);
    return linear.w > 0.0f ? (float4)(linear.xyz / linear.w, linear.w) : (float4)(0.0f);
}

/* Sample at position q. */
static inline float4 blend_sample(__global const pixel_stored *stored, __global const blend_layer *layer, float2 q,
                                  int4 border, int nearest) {
    int2 corner = floor_int2(nearest ? q : q - 0.5f);
    if (nearest)
        return grid_border(&corner, border) ? blend_tap(stored, layer, corner) : (float4)(0.0f);
    const float2 t = q - 0.5f - convert_float2(corner);
    const int2 first = corner - 1 - layer->place.xy;
    if (blend_sample_stored(layer, first, 4)) { /* mostly: then no border rule is needed */
        const blend_sample_lines lines = blend_sample_rows(stored, layer, first);
        blend_four r0, r1, r2, r3;
        blend_row(lines.a, &r0);
        blend_row(lines.b, &r1);
        blend_row(lines.c, &r2);
        blend_row(lines.d, &r3);
        const blend_four least = LEAST(LEAST(r0, r1), LEAST(r2, r3));
        const int4 valid = convert_float4(least.BLEND_ALPHAS) >= BLEND_VALID;
        if (valid.x & valid.y & valid.z & valid.w) {
            const float4 wx = cubic_taps(t.x, BLEND_SLOPE), wy = cubic_taps(t.y, BLEND_SLOPE);
            const float8 left = wy.x * blend_pair(r0.lo) + wy.y * blend_pair(r1.lo) + wy.z * blend_pair(r2.lo) +
                                wy.w * blend_pair(r3.lo);
            const float8 right = wy.x * blend_pair(r0.hi) + wy.y * blend_pair(r1.hi) + wy.z * blend_pair(r2.hi) +
                                 wy.w * blend_pair(r3.hi);
            const float4 sum = wx.x * left.lo + wx.y * left.hi + wx.z * right.lo + wx.w * right.hi;
            const float8 halves = LEAST(blend_pair(least.lo), blend_pair(least.hi));
            return (float4)(BLEND_LIT(sum, LEAST(halves.lo, halves.hi)).xyz, 1.0f);
        }
    }
    return blend_rim(stored, layer, corner, t, border);
}

/* Of PIXELS samples side by side the taps of one column, summed by the weights of rows, four for each sample; least:
   the least values met with. */
BLEND_INLINE blend_samples blend_sample_column(blend_sample_lines lines, int column, blend_samples weights,
                                               blend_pixels *least) {
    const blend_pixels a = blend_run(lines.a + column), b = blend_run(lines.b + column);
    const blend_pixels c = blend_run(lines.c + column), d = blend_run(lines.d + column);
    const blend_pixels upper = LEAST(a, b), lower = LEAST(c, d), all = LEAST(upper, lower);
    *least = column ? LEAST(*least, all) : all;
    return BLEND_EACH(weights.FIRSTS) * blend_colours(a) + BLEND_EACH(weights.SECONDS) * blend_colours(b) +
           BLEND_EACH(weights.THIRDS) * blend_colours(c) + BLEND_EACH(weights.FOURTHS) * blend_colours(d);
}

/* Samples at PIXELS positions, into c where they are wanted. Nearly all pixels move as their neighbours do: then their
   taps lie side by side as they do, and are taken together. Each sum is that of blend_sample, to the bit. */
BLEND_INLINE void blend_sample_all(__global const pixel_stored *stored, __global const blend_layer *layer,
                                   blend_real qx, blend_real qy, blend_int wanted, int4 border, int nearest,
                                   blend_samples *c) {
    const blend_between across = blend_split(qx), down = blend_split(qy);
    const blend_int apart = (across.left - across.left.x - BLEND_COUNT) | (down.left - down.left.x);
    const int2 first = (int2)(across.left.x, down.left.x) - 1 - layer->place.xy;
    if (!nearest && !BLEND_SOME(apart) && blend_sample_stored(layer, first, PIXELS + 3)) {
        const blend_sample_lines lines = blend_sample_rows(stored, layer, first);
#define BLEND_SAMPLE_ACROSS(n, i) cubic_taps(across.t.i, BLEND_SLOPE)
#define BLEND_SAMPLE_DOWN(n, i) cubic_taps(down.t.i, BLEND_SLOPE)
        const blend_samples wx = (blend_samples)(BLEND_LIST(BLEND_SAMPLE_ACROSS));
        const blend_samples wy = (blend_samples)(BLEND_LIST(BLEND_SAMPLE_DOWN));
        blend_pixels least;
        const blend_samples c0 = blend_sample_column(lines, 0, wy, &least);
        const blend_samples c1 = blend_sample_column(lines, 1, wy, &least);
        const blend_samples c2 = blend_sample_column(lines, 2, wy, &least);
        const blend_samples c3 = blend_sample_column(lines, 3, wy, &least);
        if (!BLEND_SOME(blend_colours(least).FOURTHS < BLEND_VALID)) {
            blend_samples sum = BLEND_EACH(wx.FIRSTS) * c0 + BLEND_EACH(wx.SECONDS) * c1 + BLEND_EACH(wx.THIRDS) * c2 +
                                BLEND_EACH(wx.FOURTHS) * c3;
            sum = BLEND_LIT(sum, blend_colours(least));
            sum.FOURTHS = (blend_real)(1.0f);
            *c = BLEND_EACH(wanted) ? sum : *c;
            return;
        }
    }
    if (wanted.x)
        c->s0123 = blend_sample(stored, layer, (float2)(qx.x, qy.x), border, nearest);
    if (wanted.y)
        c->s4567 = blend_sample(stored, layer, (float2)(qx.y, qy.y), border, nearest);
#if PIXELS == 4
    if (wanted.z)
        c->s89ab = blend_sample(stored, layer, (float2)(qx.z, qy.z), border, nearest);
    if (wanted.w)
        c->scdef = blend_sample(stored, layer, (float2)(qx.w, qy.w), border, nearest);
#endif
}
