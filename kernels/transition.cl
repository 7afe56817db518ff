/* How quickly the geometry changes over from one layer to the next. */

/* Strain of a layer where it changes over, |grad w_k| |F_k|, in cells of the transition grid: sums of
   w (1 - w) strain^4 and of w (1 - w) are added, so that the middle of the transition counts most, and in it the
   largest strain. Only every few columns and rows of the layer are read. */
__kernel void transition_strain(__global const float4 *displacement, /* (box.w / every, box.z / every), rounded up */
                                __global const float *blend,         /* (box.w, box.z) w_k */
                                __global const float4 *layer,        /* (box.w, box.z) r, g, b, valid */
                                int4 box, int4 border, float4 lens,  /* place on the working grid; the grid */
                                int every,                           /* columns and rows from one read to the next */
                                int4 cells,                          /* transition grid, run size */
                                __global float2 *strain)             /* (cells.y, cells.x) */
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= cells.x || cy >= cells.y)
        return;
    /* the layer's own pixels of the cell, its outermost left out */
    const int left = GREATEST(cx * border.x / cells.x - box.x, 1);
    const int top = GREATEST(cy * border.y / cells.y - box.y, 1);
    const int right = LEAST((cx + 1) * border.x / cells.x - box.x, box.z - 1);
    const int bottom = LEAST((cy + 1) * border.y / cells.y - box.y, box.w - 1);
    const int columns = (box.z + every - 1) / every;
    const float unit = lens.y == 0.0f ? 1.0f : 1.0f / lens.y;
    float2 sum = (float2)(0.0f);
    for (int y = (top + every - 1) / every * every; y < bottom; y += every) {
        const float across = lens.y == 0.0f ? 1.0f : fmax(cos(lens.z - (y + box.y + 0.5f) * lens.w), 0.02f);
        for (int x = (left + every - 1) / every * every; x < right; x += every) {
            const int at = y * box.z + x;
            const float w = blend[at];
            if (w <= 0.0f || w >= 1.0f || layer[at].w == 0.0f || layer[at - 1].w == 0.0f ||
                layer[at + 1].w == 0.0f || layer[at - box.z].w == 0.0f || layer[at + box.z].w == 0.0f)
                continue;
            const float2 slope = 0.5f * (float2)((blend[at + 1] - blend[at - 1]) / across,
                                                 blend[at + box.z] - blend[at - box.z]);
            const float3 d = displacement[y / every * columns + x / every].xyz;
            const float s = unit * ROOT(square2(slope) * square3(d)) / GREATEST(1.0f - w, 0.05f);
            const float weight = w * (1.0f - w);
            sum += weight * (float2)(s * s * s * s, 1.0f);
        }
    }
    strain[cy * cells.x + cx] += sum;
}

/* w_k to the power of the transition grid, in place; sharpened coefficients still have to sum to 1. */
__kernel void transition_sharpen(__global float *blend,           /* (box.w, box.z) w_k */
                                 int4 box, int4 border,           /* place on the working grid, run size; the grid */
                                 __global const float *power,     /* (cells.y, cells.x) */
                                 int4 cells,                      /* transition grid, over the same region */
                                 __global float *total)           /* (border.y, border.x) sum over layers */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const int at = y * box.z + x;
    float w = blend[at];
    if (w > 0.0f && w < 1.0f) {
        const float2 ratio = (float2)((float)cells.x / border.x, (float)cells.y / border.y);
        const float n = bilinear_scalar(power, ((float2)(x + box.x, y + box.y) + 0.5f) * ratio, cells);
        const float exponent = n * logarithm(w);
        w = exponent > -87.0f ? exponential(exponent) : 0.0f;
    }
    blend[at] = w;
    total[(y + box.y) * border.x + x + box.x] += w;
}

/* Coefficients that sum to 1, in place. */
__kernel void transition_ratio(__global float *blend,          /* (box.w, box.z) */
                               int4 box, int4 border,          /* place on the working grid, run size; the grid */
                               __global const float *total)    /* (border.y, border.x) */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const float sum = total[(y + box.y) * border.x + x + box.x];
    if (sum > 0.0f)
        blend[y * box.z + x] /= sum;
}
