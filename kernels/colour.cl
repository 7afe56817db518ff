/* How two aligned layers differ in exposure and colour, per cell of a coarse colour grid. */

static inline float4 colour_sample(__global const float4 *layer, int4 box, float2 q, int4 border) {
    const float2 p = q - 0.5f, base = floor(p), t = p - base;
    float4 sum = (float4)(0.0f);
    for (int j = 0; j < 2; ++j)
        for (int i = 0; i < 2; ++i) {
            int2 c = convert_int2(base) + (int2)(i, j);
            if (!grid_border(&c, border))
                continue;
            const int at = box_index(c, box);
            if (at >= 0)
                sum += (i ? t.x : 1.0f - t.x) * (j ? t.y : 1.0f - t.y) * layer[at];
        }
    return sum.w > 0.999f ? sum : (float4)(0.0f);
}

/* Where a layer is sampled for working pixel p. */
static inline float2 colour_position(int2 p, float3 d, float4 lens) {
    const float2 q = (float2)(p.x + 0.5f, p.y + 0.5f);
    if (d.x == 0.0f && d.y == 0.0f && d.z == 0.0f)
        return q;
    return canvas_position(canvas_point(q, lens) + d, lens);
}

/* Mean difference a - b on the exposure scale over the pixels of a cell (every second one in x and y) that both
   layers show unclipped, and how far it can be trusted: less where the pixels disagree among themselves, that
   is, where the layers do not show the same thing. */
__kernel void colour_difference(__global const float4 *layer_a, __global const float4 *field_a, int4 box_a,
                                __global const float4 *layer_b, __global const float4 *field_b, int4 box_b,
                                int4 border, float4 lens,   /* working grid */
                                int4 cells,                 /* colour grid, run size */
                                int integer,                /* which exposure scale */
                                float clipped,              /* brighter samples are not used */
                                float spread,               /* disagreement that halves the trust */
                                __global float4 *difference) /* (cells.y, cells.x): r, g, b, weight 0..1 */
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= cells.x || cy >= cells.y)
        return;
    const int left = cx * border.x / cells.x, right = (cx + 1) * border.x / cells.x;
    const int top = cy * border.y / cells.y, bottom = (cy + 1) * border.y / cells.y;
    float3 sum = (float3)(0.0f);
    float squares = 0.0f, n = 0.0f, tried = 0.0f;
    for (int y = top; y < bottom; y += 2)
        for (int x = left; x < right; x += 2) {
            tried += 1.0f;
            const int2 p = (int2)(x, y);
            const int at_a = box_index(p, box_a), at_b = box_index(p, box_b);
            if (at_a < 0 || at_b < 0 || layer_a[at_a].w == 0.0f || layer_b[at_b].w == 0.0f)
                continue;
            const float4 a = colour_sample(layer_a, box_a, colour_position(p, field_a[at_a].xyz, lens), border);
            const float4 b = colour_sample(layer_b, box_b, colour_position(p, field_b[at_b].xyz, lens), border);
            if (a.w == 0.0f || b.w == 0.0f || any(a.xyz > clipped) || any(b.xyz > clipped))
                continue;
            const float3 d = exposure_scale(a.xyz, integer) - exposure_scale(b.xyz, integer);
            sum += d;
            squares += dot(d, d);
            n += 1.0f;
        }
    float4 result = (float4)(0.0f);
    if (n > 0.0f) {
        const float3 mean = sum / n;
        const float variance = fmax(0.0f, squares / n - dot(mean, mean));
        result = (float4)(mean, n / tried / (1.0f + variance / (spread * spread)));
    }
    difference[cy * cells.x + cx] = result;
}
