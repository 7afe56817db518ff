/* What a layer shows in cells of the seam grid. */

/* Mean colour of an aligned, corrected layer, as seen, over the pixels of a cell (every second one in x and y) that
   it shows, and the share of these. */
__kernel void clones_look(__global const float4 *layer, __global const float4 *field, int4 box,
                          __global const float4 *gain, /* (colours.y, colours.x) */
                          int4 border, float4 lonlat,  /* working grid */
                          int4 colours, int4 cells,    /* grid of the gains; seam grid */
                          int4 part,                   /* cells that are looked at, run size */
                          float shoulder,              /* of the exposure scale */
                          __global float4 *shown)      /* (part.w, part.z): r, g, b, share */
{
    const int column = get_global_id(0), row = get_global_id(1);
    if (column >= part.z || row >= part.w)
        return;
    const int cx = part.x + column, cy = part.y + row;
    const int4 its = cell_pixels(cx, cy, border, cells);
    const int g = gain_index(cx, cy, cells, colours);
    float3 sum = (float3)(0.0f);
    float n = 0.0f, tried = 0.0f;
    for (int y = its.y; y < its.w; y += 2)
        for (int x = its.x; x < its.z; x += 2) {
            tried += 1.0f;
            float4 c;
            if (!layer_shown(layer, field, box, (int2)(x, y), border, lonlat, &c))
                continue;
            sum += exposure_look(c.xyz, gain[g].xyz, shoulder);
            n += 1.0f;
        }
    shown[row * part.z + column] = n > 0.0f ? (float4)(sum / n, n / tried) : (float4)(0.0f);
}
