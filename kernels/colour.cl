/* How two aligned layers differ in exposure and colour, per cell of a coarse colour grid. */

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
            float4 a, b;
            if (!layer_pair(layer_a, field_a, box_a, layer_b, field_b, box_b, (int2)(x, y), border, lens, &a, &b) ||
                a.x > clipped || a.y > clipped || a.z > clipped || b.x > clipped || b.y > clipped || b.z > clipped)
                continue;
            const float3 d = exposure_scale(a.xyz, integer) - exposure_scale(b.xyz, integer);
            sum += d;
            squares += square3(d);
            n += 1.0f;
        }
    float4 result = (float4)(0.0f);
    if (n > 0.0f) {
        const float3 mean = sum / n;
        const float variance = squares / n - square3(mean);
        result = (float4)(mean, n / tried / (1.0f + GREATEST(variance, 0.0f) / (spread * spread)));
    }
    difference[cy * cells.x + cx] = result;
}
