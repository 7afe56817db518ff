/* How two aligned layers differ in exposure and colour, per cell of a coarse colour grid. */

/* The brightest channel up to which a sample of an integer image tells nothing of exposure, and from which on all that
   it can. */
#define COLOUR_DARK 0.05f
#define COLOUR_BRIGHT 0.3f

static inline bool colour_clips(float4 c, float4 clipped) {
    return c.x > clipped.x || c.y > clipped.y || c.z > clipped.z;
}

/* How much two samples tell of exposure, 0..1: what is nearly black in either may have been any darker, most of all at
   the rim of a dark lens, and by how much is seen by nobody. Floats are light, without such an end: all tell. */
static inline float colour_tells(float4 a, float4 b, float shoulder) {
    return shoulder > 0.0f ? ramp(darker_channel(a.xyz, b.xyz), COLOUR_DARK, COLOUR_BRIGHT) : 1.0f;
}

/* Mean difference a - b on the exposure scale over the pixels of a cell (every second one in x and y) that both
   layers show unclipped, by what they tell, and how far it can be trusted: less where the pixels disagree among
   themselves, that is, where the layers do not show the same thing. The same where one of them is clipped, if that is
   most of the cell: the other has to be raised by that much at least. How far both are seen, by their weights. And the
   mean of both on the exposure scale, of the samples that are compared. */
__kernel void colour_difference(__global const float4 *layer_a, __global const float4 *field_a, int4 box_a,
                                __global const float4 *layer_b, __global const float4 *field_b, int4 box_b,
                                int4 border, float4 lonlat, /* working grid */
                                int4 cells, int4 part,      /* colour grid; its cells that are compared, run size */
                                float shoulder,             /* of the exposure scale */
                                float4 clipped_a, float4 clipped_b, /* brighter samples may have been any brighter */
                                float spread,               /* disagreement that halves the trust */
                                __global float4 *difference, /* (part.w, part.z): r, g, b, weight 0..1 */
                                __global float4 *beyond,     /* the same; weight > 0: a is clipped, < 0: b */
                                __global float *mixing,      /* (part.w, part.z) 0..1 */
                                __global float *level)       /* the same, of all channels */
{
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= part.z || row >= part.w)
        return;
    const int4 its = cell_pixels(part.x + column, part.y + row, border, cells);
    float3 sum = (float3)(0.0f), both = sum, more = sum, less = sum;
    float squares = 0.0f, n = 0.0f, tried = 0.0f, above = 0.0f, below = 0.0f, mixed = 0.0f;
    for (int y = its.y; y < its.w; y += 2)
        for (int x = its.x; x < its.z; x += 2) {
            tried += 1.0f;
            float4 a, b;
            if (!layer_pair(layer_a, field_a, box_a, layer_b, field_b, box_b, (int2)(x, y), border, lonlat, &a, &b))
                continue;
            const float s = field_a[box_index((int2)(x, y), box_a)].w;
            const float t = field_b[box_index((int2)(x, y), box_b)].w;
            mixed += 4.0f * s * t / GREATEST((s + t) * (s + t), 1e-20f);
            const float3 light_a = exposure_scale(a.xyz, shoulder), light_b = exposure_scale(b.xyz, shoulder);
            const float3 d = light_a - light_b;
            const bool clips_a = colour_clips(a, clipped_a), clips_b = colour_clips(b, clipped_b);
            if (clips_a && !clips_b) {
                more += d;
                above += 1.0f;
            } else if (clips_b && !clips_a) {
                less += d;
                below += 1.0f;
            } else if (!clips_a) {
                const float tells = colour_tells(a, b, shoulder);
                sum += tells * d;
                both += tells * (light_a + light_b);
                squares += tells * square3(d);
                n += tells;
            }
        }
    float4 result = (float4)(0.0f);
    if (n > 0.0f) {
        const float3 mean = sum / n;
        const float variance = squares / n - square3(mean);
        result = (float4)(mean, n / tried / (1.0f + GREATEST(variance, 0.0f) / (spread * spread)));
    }
    difference[row * part.z + column] = result;
    result = (float4)(0.0f);
    if (2.0f * above > tried)
        result = (float4)(more / above, 2.0f * above / tried - 1.0f);
    if (2.0f * below > tried)
        result = (float4)(less / below, 1.0f - 2.0f * below / tried);
    beyond[row * part.z + column] = result;
    mixing[row * part.z + column] = mixed / GREATEST(tried, 1.0f);
    level[row * part.z + column] = n > 0.0f ? dot(both, (float3)(1.0f / 6.0f)) / n : 0.0f;
}

/* How far exposure scales of four shoulders are from explaining the difference of two aligned layers: per cell
   the mean square, of full scale, of what one gain for the cell leaves of it. */
__kernel void colour_misfit(__global const float4 *layer_a, __global const float4 *field_a, int4 box_a,
                            __global const float4 *layer_b, __global const float4 *field_b, int4 box_b,
                            int4 border, float4 lonlat,  /* working grid */
                            int4 cells, int4 part,     /* colour grid; its cells that are compared, run size */
                            float4 shoulders,
                            float4 clipped_a, float4 clipped_b, /* brighter samples are not used */
                            __global float4 *misfit)   /* (part.w, part.z), for each shoulder */
{
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= part.z || row >= part.w)
        return;
    const int4 its = cell_pixels(part.x + column, part.y + row, border, cells);
    float4 weight[3], first[3], second[3];
    for (int k = 0; k < 3; ++k)
        weight[k] = first[k] = second[k] = (float4)(0.0f);
    float tried = 0.0f;
    for (int y = its.y; y < its.w; y += 4)
        for (int x = its.x; x < its.z; x += 4) {
            tried += 1.0f;
            float4 a, b;
            if (!layer_pair(layer_a, field_a, box_a, layer_b, field_b, box_b, (int2)(x, y), border, lonlat, &a, &b) ||
                colour_clips(a, clipped_a) || colour_clips(b, clipped_b))
                continue;
            const float p[3] = {a.x, a.y, a.z}, q[3] = {b.x, b.y, b.z};
            for (int k = 0; k < 3; ++k) {
                const float u = GREATEST(p[k], EXPOSURE_FLOOR), v = GREATEST(q[k], EXPOSURE_FLOOR);
                const float m = 0.5f * (u + v);
                const float4 d = logarithm4(u * (1.0f - shoulders * v) / (v * (1.0f - shoulders * u)));
                const float4 slope = m * (1.0f - shoulders * m); /* of the colour over the scale */
                weight[k] += slope * slope;
                first[k] += slope * slope * d;
                second[k] += slope * slope * d * d;
            }
        }
    float4 left_over = (float4)(0.0f);
    for (int k = 0; k < 3; ++k)
        left_over += second[k] - first[k] * first[k] / GREATEST(weight[k], (float4)(1e-12f));
    misfit[row * part.z + column] = left_over / GREATEST(tried, 1.0f);
}
