/* Layers seen on a pair's chart. */

#define CHART_SLOPE -0.5f /* Catmull-Rom: parabolas stay, and flow with them */

static inline float4 chart_tap(__global const float4 *layer, int4 box, int2 p, int4 border) {
    if (!grid_border(&p, border))
        return (float4)(0.0f);
    const int at = box_index(p, box);
    return at < 0 ? (float4)(0.0f) : layer[at];
}

static inline float4 chart_row(__global const float4 *row, float4 weights, float *valid) {
    *valid *= row[0].w * row[1].w * row[2].w * row[3].w;
    return weights.x * row[0] + weights.y * row[1] + weights.z * row[2] + weights.w * row[3];
}

/* Weights of four taps around fraction t: to read between pixels, or for every second one. The latter are a tent
   two pixels wide to each side, so that texture finer than the chart is averaged, not taken for something else. */
static inline float4 chart_weights(float t, int coarse) {
    return coarse == 1 ? cubic_taps(t, CHART_SLOPE) : 0.25f * (float4)(1.0f - t, 2.0f - t, 1.0f + t, t);
}

/* Pixels of a row that a work item takes: compilers for CPUs make vectors only of what is written as vectors. */
#define CHART_CHUNK 4

/* Brightness of a layer at position p of the canvas grid, by these weights where all taps are valid, bilinear at
   the rim of the mask; negative where there is none. */
static float chart_brightness(__global const float4 *layer, int4 box, int4 border, float2 p, int coarse) {
    const float3 luma = (float3)(0.299f, 0.587f, 0.114f);
    p -= 0.5f;
    int2 corner = floor_int2(p);
    float2 t = p - convert_float2(corner);
    /* positions come out of trigonometry or scaling: what is a whole pixel but for rounding is a copy */
    if (t.x > 0.9995f) { corner.x += 1; t.x = 0.0f; }
    if (t.y > 0.9995f) { corner.y += 1; t.y = 0.0f; }
    t = t < 0.0005f ? (float2)(0.0f) : t;
    if (chart_tap(layer, box, corner, border).w == 0.0f) /* which counts wherever a pixel is read */
        return -1.0f;
    const float4 wx = chart_weights(t.x, coarse), wy = chart_weights(t.y, coarse);
    const int2 first = corner - 1 - box.xy;
    if (first.x >= 0 && first.y >= 0 && first.x + 3 < box.z && first.y + 3 < box.w) {
        /* nearly all samples: every tap is stored, no border rule is needed */
        __global const float4 *row = layer + first.y * box.z + first.x;
        float valid = 1.0f;
        float4 all = wy.x * chart_row(row, wx, &valid);
        all += wy.y * chart_row(row + box.z, wx, &valid);
        all += wy.z * chart_row(row + 2 * box.z, wx, &valid);
        all += wy.w * chart_row(row + 3 * box.z, wx, &valid);
        if (valid != 0.0f) {
            const float3 c = luma * GREATEST(all.xyz, (float3)(0.0f));
            return c.x + c.y + c.z;
        }
    }
    const float ax[4] = {wx.x, wx.y, wx.z, wx.w}, ay[4] = {wy.x, wy.y, wy.z, wy.w};
    float4 cubic = (float4)(0.0f), linear = (float4)(0.0f);
    bool inner = true, outer = true;
    for (int y = 0; y < 4; ++y)
        for (int x = 0; x < 4; ++x) {
            const float w = ax[x] * ay[y];
            const float4 c = chart_tap(layer, box, corner + (int2)(x - 1, y - 1), border);
            cubic += w * c;
            const bool centre = x > 0 && x < 3 && y > 0 && y < 3;
            const float l = centre ? (x == 1 ? 1.0f - t.x : t.x) * (y == 1 ? 1.0f - t.y : t.y) : 0.0f;
            linear += l * c;
            outer = outer && (w == 0.0f || c.w != 0.0f);
            inner = inner && (l == 0.0f || c.w != 0.0f);
        }
    const float3 found = outer ? cubic.xyz : linear.xyz, c = luma * GREATEST(found, (float3)(0.0f));
    return inner ? c.x + c.y + c.z : -1.0f;
}

/* Log brightness of a layer on a chart; 0 where there is none. */
__kernel void chart_sample(__global const float4 *layer, /* (box.w, box.z) r, g, b, valid */
                           int4 box,                     /* place of `layer` on the canvas grid */
                           int4 border, float4 lonlat,   /* canvas grid */
                           float16 chart, int2 size,     /* run size: size.x by CHART_CHUNK, rounded up, size.y */
                           int coarse,                   /* pixels of the canvas grid per pixel, 1 or 2 */
                           float floor_value,            /* added before the logarithm: dark noise */
                           __global float *image,        /* (size.y, size.x) */
                           __global float *mask)         /* (size.y, size.x), 0 or 1 */
{
    const int i = get_global_id(0) * CHART_CHUNK, j = get_global_id(1);
    if (i >= size.x || j >= size.y)
        return;
    const float4 u = convert_float4(i + (int4)(0, 1, 2, 3)) + 0.5f;
    float4 py;
    const float4 px = chart_places(u, (float4)(j + 0.5f), &chart, lonlat, &py);
    const float2 places[CHART_CHUNK] = {(float2)(px.x, py.x), (float2)(px.y, py.y), (float2)(px.z, py.z),
                                        (float2)(px.w, py.w)};
    for (int k = 0; k < CHART_CHUNK && i + k < size.x; ++k) {
        const float brightness = chart_brightness(layer, box, border, places[k], coarse);
        image[j * size.x + i + k] = brightness < 0.0f ? 0.0f : logarithm(brightness + floor_value);
        mask[j * size.x + i + k] = brightness < 0.0f ? 0.0f : 1.0f;
    }
}
