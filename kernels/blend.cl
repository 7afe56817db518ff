/* The full-resolution pass over one band of rows. Built with PIXEL (stored sample type), SAMPLES (2 or 4, alpha
   last), WHITE (full scale) and INTEGER (1: round and saturate). Band pixels are canvas pixels; `band` is the
   band's place in the region: left, top, width, height. */

/* How many layers cover each pixel: 0, 1 or 2 for several. */
__kernel void blend_count(__global const PIXEL *rows, /* (box.w, box.z, SAMPLES) */
                          int4 box, int4 band,        /* place of `rows`; band, run size */
                          __global uchar *count)      /* (band.w, band.z) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= band.z || y >= band.w)
        return;
    const int at = box_index((int2)(x + band.x, y + band.y), box);
    if (at >= 0 && (float)rows[(size_t)at * SAMPLES + SAMPLES - 1] >= 0.5f * WHITE)
        count[y * band.z + x] = min(count[y * band.z + x] + 1, 2); /* one or several is all that matters */
}

static inline float4 blend_pixel(__global const PIXEL *rows, int at) {
    __global const PIXEL *p = rows + (size_t)at * SAMPLES;
    const float valid = (float)p[SAMPLES - 1] >= 0.5f * WHITE ? 1.0f : 0.0f;
    return valid != 0.0f ? (float4)(p[0], p[SAMPLES > 2 ? 1 : 0], p[SAMPLES > 2 ? 2 : 0], 1.0f) : (float4)(0.0f);
}

static inline float4 blend_tap(__global const PIXEL *rows, int4 box, int2 p, int4 border) {
    if (!grid_border(&p, border))
        return (float4)(0.0f);
    const int at = box_index(p, box);
    return at < 0 ? (float4)(0.0f) : blend_pixel(rows, at);
}

/* Bicubic sample at position q; next to the mask's rim bilinear over the valid taps, whose share is w. */
static inline float4 blend_sample(__global const PIXEL *rows, int4 box, float2 q, int4 border, int nearest) {
    if (nearest)
        return blend_tap(rows, box, convert_int2(floor(q)), border);
    const float2 p = q - 0.5f, base = floor(p), t = p - base;
    const int2 corner = convert_int2(base);
    const float4 wx = catmull_rom(t.x), wy = catmull_rom(t.y);
    const float ax[4] = {wx.x, wx.y, wx.z, wx.w}, ay[4] = {wy.x, wy.y, wy.z, wy.w};
    const int2 first = corner - 1 - box.xy;
    if (first.x >= 0 && first.y >= 0 && first.x + 3 < box.z && first.y + 3 < box.w) {
        /* nearly all samples: every tap is stored, no border rule is needed */
        float4 all = (float4)(0.0f);
        float valid = 1.0f;
        for (int j = 0; j < 4; ++j) {
            const int at = (first.y + j) * box.z + first.x;
            float4 row = (float4)(0.0f);
            for (int i = 0; i < 4; ++i) {
                const float4 c = blend_pixel(rows, at + i);
                row += ax[i] * c;
                valid *= c.w;
            }
            all += ay[j] * row;
        }
        if (valid != 0.0f)
            return (float4)(all.xyz, 1.0f);
    }
    float4 cubic = (float4)(0.0f), linear = (float4)(0.0f);
    int missing = 0;
    for (int j = 0; j < 4; ++j) {
        float4 row = (float4)(0.0f);
        for (int i = 0; i < 4; ++i) {
            const float4 c = blend_tap(rows, box, corner + (int2)(i - 1, j - 1), border);
            row += ax[i] * c;
            missing += c.w == 0.0f;
            if (i > 0 && i < 3 && j > 0 && j < 3)
                linear += (i == 1 ? 1.0f - t.x : t.x) * (j == 1 ? 1.0f - t.y : t.y) * c;
        }
        cubic += ay[j] * row;
    }
    if (missing == 0)
        return (float4)(cubic.xyz, 1.0f);
    return linear.w > 0.0f ? (float4)(linear.xyz / linear.w, linear.w) : (float4)(0.0f);
}

/* Bilinear reading of a float4 grid that covers `box` of a canvas grid; beyond the box, the box's rim. */
static inline float4 blend_field(__global const float4 *field, int4 box, float2 q, int4 border) {
    const float2 p = q - 0.5f, base = floor(p), t = p - base;
    float4 sum = (float4)(0.0f);
    for (int j = 0; j < 2; ++j)
        for (int i = 0; i < 2; ++i) {
            int2 c = convert_int2(base) + (int2)(i, j);
            if (border.z && box.z == border.x) {
                c.y = clamp(c.y, 0, border.y - 1);
                grid_border(&c, border);
            }
            const int x = clamp(c.x - box.x, 0, box.z - 1), y = clamp(c.y - box.y, 0, box.w - 1);
            sum += (i ? t.x : 1.0f - t.x) * (j ? t.y : 1.0f - t.y) * field[y * box.z + x];
        }
    return sum;
}

/* atan2 of a positive x; a few terms of the series do where the angle is small, as it nearly always is. */
static inline float blend_angle(float y, float x) {
    const float t = y / x, t2 = t * t;
    if (x > 0.0f && t2 < 0.01f)
        return t * (1.0f - t2 * (1.0f / 3.0f - t2 * (0.2f - t2 / 7.0f)));
    return atan2(y, x);
}

/* Where layer k is sampled for the pixel at p: the field's displacement carried to full resolution. */
static inline float2 blend_position(float2 p, float3 d, float2 ratio, float4 lens) {
    if (d.x == 0.0f && d.y == 0.0f && d.z == 0.0f)
        return p;
    if (lens.y == 0.0f)
        return p + d.xy * ratio;
    /* in the frame of p (east, north, up) the change of longitude is small, hence exact in float32 */
    const float lon = lens.x + p.x * lens.y, lat = lens.z - p.y * lens.w;
    float cl, cp;
    const float sl = sincos(lon, &cl), sp = sincos(lat, &cp);
    const float horizontal = sl * d.x + cl * d.y;
    const float east = cl * d.x - sl * d.y, out = cp + horizontal;
    const float north = sp + d.z, level = sqrt(east * east + out * out);
    return (float2)(p.x + blend_angle(east, out) / lens.y,
                    p.y - blend_angle(north * cp - level * sp, level * cp + north * sp) / lens.w);
}

/* Smooth exposure correction of a colour in stored units. */
static inline float3 blend_correct(float3 c, float3 gain) {
    if (all(gain == 0.0f))
        return c;
    const float3 corrected = exposure_shift(c / WHITE, gain, INTEGER) * WHITE;
    return select(corrected, c, gain == 0.0f);
}

/* Add one layer. The sum is of differences from a reference, so that equal colours stay equal to the bit. */
__kernel void blend_add(__global const PIXEL *rows, /* (box.w, box.z, SAMPLES) */
                        int4 box, int4 band,        /* place of `rows`; band, run size */
                        int4 border, float4 lens,   /* full-resolution grid of the region */
                        __global const float4 *field, int4 field_box, int4 field_border, /* working grid */
                        __global const float4 *gain, int4 gain_border, /* colour grid, r, g, b */
                        int corrected,                                 /* 0: gain is not read */
                        int nearest,                                   /* 1: nearest-neighbour sampling */
                        __global const uchar *count,                   /* (band.w, band.z) */
                        __global float4 *reference, /* (band.w, band.z) colour; 1 if set, 2 if corrected */
                        __global float4 *sum)                          /* (band.w, band.z) weighted, weight */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= band.z || y >= band.w)
        return;
    const int2 place = (int2)(x + band.x, y + band.y);
    const int inside = box_index(place, box);
    if (inside < 0)
        return;
    const float4 own = blend_pixel(rows, inside);
    if (own.w == 0.0f)
        return;
    const int at = y * band.z + x;
    const float2 p = (float2)(place.x + 0.5f, place.y + 0.5f);
    const float2 scale = (float2)((float)border.x / field_border.x, (float)border.y / field_border.y);
    float3 g = (float3)(0.0f);
    if (corrected) {
        const float2 q = p * (float2)((float)gain_border.x / border.x, (float)gain_border.y / border.y);
        g = blend_field(gain, (int4)(0, 0, gain_border.x, gain_border.y), q, gain_border).xyz;
    }
    const float state = any(g != 0.0f) ? 2.0f : 1.0f;
    float4 first = reference[at];
    if (first.w == 0.0f) {
        first = (float4)(blend_correct(own.xyz, g), state);
        reference[at] = first;
    }
    if (count[at] < 2)
        return;
    const float4 f = blend_field(field, field_box, p / scale, field_border);
    if (f.w <= 0.0f)
        return;
    const float4 c = blend_sample(rows, box, blend_position(p, f.xyz, scale, lens), border, nearest);
    /* a sample that falls outside its layer counts smoothly less */
    const float w = f.w * c.w * c.w;
    if (w > 0.0f) {
        sum[at] += (float4)((blend_correct(c.xyz, g) - first.xyz) * w, w);
        if (state > first.w)
            reference[at] = (float4)(first.xyz, state);
    }
}

/* The fraction above which a value is rounded up at canvas pixel (x, y): uniform in 0..1, so that the mean of
   many rounded pixels is right. Steps of the golden ratio spread it evenly along a row, which halves the noise
   that is coarse enough to be seen; where rows begin is mixed from all bits of y and channel. */
static inline float blend_threshold(int x, int y, int channel) {
    uint h = (uint)y * 4u + (uint)channel;
    h = (h ^ (h >> 16)) * 0x85ebca6bu;
    h = (h ^ (h >> 13)) * 0xc2b2ae35u;
    h ^= h >> 16;
    return ((float)((h + (uint)x * 0x9e3779b9u) >> 16) + 0.5f) / 65536.0f;
}

/* A whole number by dither. What is whole but for the rounding of float32 stays as it is. */
static inline float blend_dither(float v, float threshold) {
    const float whole = rint(v), below = floor(v);
    if (fabs(v - whole) <= 2e-7f * WHITE)
        return whole;
    return v - below > threshold ? below + 1.0f : below;
}

/* Round once. Corrected pixels are dithered: a smooth gain on a smooth sky would show as bands. */
__kernel void blend_finish(__global const float4 *reference, /* (band.w, band.z) */
                           __global const float4 *sum,       /* (band.w, band.z) */
                           int4 band,                        /* run size */
                           int2 origin,                      /* the region's place on the canvas */
                           __global PIXEL *out)              /* (band.w, band.z, SAMPLES) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= band.z || y >= band.w)
        return;
    const int at = y * band.z + x;
    const float4 s = sum[at], r = reference[at];
    const float3 c = r.xyz + (s.w > 1e-30f ? s.xyz / s.w : (float3)(0.0f));
    const float alpha = fmin(r.w, 1.0f) * WHITE;
    const float v[4] = {c.x, SAMPLES > 2 ? c.y : alpha, c.z, alpha};
    const int dithered = INTEGER && r.w > 1.0f;
    for (int k = 0; k < SAMPLES; ++k) {
        float value = v[k];
        if (dithered)
            value = blend_dither(value, blend_threshold(x + band.x + origin.x, y + band.y + origin.y, k));
        else if (INTEGER)
            value = rint(value);
        out[(size_t)at * SAMPLES + k] = (PIXEL)(INTEGER ? clamp(value, 0.0f, (float)WHITE) : value);
    }
}
