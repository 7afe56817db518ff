/* Layers at working resolution. Built with PIXEL (stored sample type) and SAMPLES (2 or 4, alpha last). */

/* Area mean of the full-resolution pixels under each working pixel; integer weights, because working edges lie
   at fractions of a pixel. Valid only if every pixel under it is. */
__kernel void working_reduce(__global const pixel_stored *rows, /* (box.w, box.z) */
                             int4 box,      /* place of `rows` in the region: left, top, width, height, px */
                             int4 ratio,    /* region width, working width, region height, working height */
                             int4 out_box,  /* place of `layer` on the working grid */
                             int first,     /* first row of `layer` to calculate */
                             int2 size,     /* run size: out_box.z columns, rows to calculate */
                             float white,   /* value of full scale */
                             __global float4 *layer) /* (out_box.w, out_box.z): r, g, b in 0..1, valid */
{
    const int i = get_global_id(0), j = get_global_id(1) + first;
    if (i >= size.x || j >= first + size.y)
        return;
    const int x0 = (i + out_box.x) * ratio.x, x1 = x0 + ratio.x; /* edges, times working width */
    const int y0 = (j + out_box.y) * ratio.z, y1 = y0 + ratio.z;
    const int left = x0 / ratio.y - box.x, right = (x1 - 1) / ratio.y - box.x;
    const int top = y0 / ratio.w - box.y, bottom = (y1 - 1) / ratio.w - box.y;
    bool valid = left >= 0 && top >= 0 && right < box.z && bottom < box.w;
    /* how much of the outermost columns lies beside the working pixel */
    const float before = x0 - (left + box.x) * ratio.y, after = (right + box.x + 1) * ratio.y - x1;
    float4 sum = (float4)(0.0f);
    float least = white;
    for (int y = top; y <= bottom && valid; ++y) {
        __global const pixel_stored *row = rows + y * box.z;
        float4 across = (float4)(0.0f);
        for (int x = left; x <= right; ++x) {
            const float4 c = pixel_samples(row[x]);
            across += c;
            least = LEAST(c.w, least);
        }
        across = ratio.y * across - before * pixel_samples(row[left]) - after * pixel_samples(row[right]);
        sum += (float)(LEAST(y1, (y + box.y + 1) * ratio.w) - GREATEST(y0, (y + box.y) * ratio.w)) * across;
        valid = least >= 0.5f * white;
    }
    const float scale = 1.0f / (white * ratio.x * ratio.z);
    layer[j * out_box.z + i] = valid ? (float4)(sum.xyz * scale, 1.0f) : (float4)(0.0f);
}

/* Raise `differs` if two layers show different colours on a working pixel that both cover. */
__kernel void working_compare(__global const float4 *a, int4 a_box, /* run size: a_box.zw */
                              __global const float4 *b, int4 b_box, __global int *differs)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= a_box.z || y >= a_box.w)
        return;
    const int at = box_index((int2)(x + a_box.x, y + a_box.y), b_box);
    if (at < 0)
        return;
    const float4 p = a[y * a_box.z + x], q = b[at];
    if (p.w != 0.0f && q.w != 0.0f && (p.x != q.x || p.y != q.y || p.z != q.z))
        *differs = 1;
}
