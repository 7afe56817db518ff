/* Where a mean of two layers would show what they do not share twice. */

/* The least weight that is told from none, about exp(-87). */
#define GHOSTS_LEAST 1.7e-38f

/* Raise a layer's weight to a power, bilinear from cells: where it is above 1 the change from one layer to the next is
   so many times as quick, and stays where both weigh the same. */
__kernel void ghosts_sharpen(__global float4 *field,        /* (box.w, box.z) displacement, weight; in place */
                             int4 box, int4 border,         /* place on the working grid, run size; the grid */
                             __global const float *power,   /* (cells.y, cells.x), 1 or more */
                             int4 cells)                    /* over the same region */
{
    const int x = get_global_id(0), y = get_global_id(1), at = y * box.z + x;
    if (x >= box.z || y >= box.w || !(field[at].w > 0.0f))
        return;
    const float2 place = (float2)(x + box.x + 0.5f, y + box.y + 0.5f) * grid_ratio(border, cells);
    const float its = bilinear_scalar(power, place, cells);
    /* none becomes nothing: a pixel that no other layer can fill stays opaque */
    if (its > 1.0f)
        field[at].w = exponential(GREATEST(its * logarithm(GREATEST(field[at].w, GHOSTS_LEAST)), -87.0f));
}
