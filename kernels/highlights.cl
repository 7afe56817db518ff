/* What a layer shows clipped counts less beside a layer that shows more of it. */

/* How much of a layer's pixels in a cell is clipped, 0..1; each counts from nothing at `nearly` to all at `surely`,
   of what the layer shows white. 0 where the layer is not. */
__kernel void highlights_share(__global const float4 *layer, /* (box.w, box.z) r, g, b, valid */
                               int4 box,                     /* place on the working grid */
                               int4 border, int4 cells,      /* working grid; highlights grid, run size */
                               float4 white,                 /* what the layer shows white, r, g, b */
                               float nearly, float surely,   /* of that, in the brightest channel */
                               __global float *share)        /* (cells.y, cells.x) */
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= cells.x || cy >= cells.y)
        return;
    const int4 its = cell_pixels(cx, cy, border, cells);
    const int left = GREATEST(its.x - box.x, 0), right = LEAST(its.z - box.x, box.z);
    const int top = GREATEST(its.y - box.y, 0), bottom = LEAST(its.w - box.y, box.w);
    float sum = 0.0f, n = 0.0f;
    for (int y = top; y < bottom; ++y)
        for (int x = left; x < right; ++x) {
            const float4 c = layer[y * box.z + x] / white;
            const float brightest = GREATEST(c.x, GREATEST(c.y, c.z));
            const float valid = c.w > 0.0f ? 1.0f : 0.0f;
            sum += valid * ramp(brightest, nearly, surely);
            n += valid;
        }
    share[cy * cells.x + cx] = n > 0.0f ? sum / n : 0.0f;
}

/* Divide a layer's colour weight by what the cells tell the logarithm of. */
__kernel void highlights_reduce(__global float4 *field,           /* (box.w, box.z) of the working grid; w is scaled */
                                int4 box, int4 border,            /* place on the working grid, run size; that grid */
                                __global const float *logarithms, /* (cells.y, cells.x), 0 or more */
                                int4 cells)                       /* highlights grid, over the same region */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const float2 place = (float2)(x + box.x + 0.5f, y + box.y + 0.5f) * grid_ratio(border, cells);
    const float logarithm = bilinear_scalar(logarithms, place, cells);
    if (logarithm > 0.0f) /* hardly anywhere: elsewhere nothing is read or written */
        field[y * box.z + x].w *= exponential(-logarithm);
}

/* The reverse of highlights_reduce, as far as the cells of another grid over the same region tell. */
__kernel void highlights_restore(__global float4 *field,           /* (box.w, box.z) of the working grid; w is scaled */
                                 int4 box, int4 border,            /* place on the working grid, run size; that grid */
                                 __global const float *logarithms, /* (cells.y, cells.x), 0 or more */
                                 int4 cells,                       /* highlights grid */
                                 __global const float *part,       /* (part_cells.y, part_cells.x), 0..1 */
                                 int4 part_cells)
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const float2 place = (float2)(x + box.x + 0.5f, y + box.y + 0.5f) / (float2)(border.x, border.y);
    const float2 on_part = place * (float2)(part_cells.x, part_cells.y), on_cells = place * (float2)(cells.x, cells.y);
    const float share = bilinear_scalar(part, on_part, part_cells);
    if (share > 0.0f)
        field[y * box.z + x].w *= exponential(share * bilinear_scalar(logarithms, on_cells, cells));
}
