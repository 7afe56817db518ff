/* Where one layer is taken whole. */

/* Take a layer's colour weight away where it yields: bilinear from the seam grid. A trace is left, so that a
   pixel that no other layer can fill stays opaque. */
__kernel void seam_yield(__global float4 *field,        /* (box.w, box.z) of the working grid; w is scaled */
                         int4 box, int4 border,         /* place on the working grid, run size; working grid */
                         __global const float *yields,  /* (cells.y, cells.x), 0..1 */
                         int4 cells)                    /* seam grid, over the same region */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= box.z || y >= box.w)
        return;
    const float2 ratio = (float2)((float)cells.x / border.x, (float)cells.y / border.y);
    const float keep = 1.0f - bilinear_scalar(yields, (float2)(x + box.x + 0.5f, y + box.y + 0.5f) * ratio, cells);
    /* to the fourth power: the softmax's own weights span many powers of ten */
    field[y * box.z + x].w *= fmax(keep * keep * keep * keep, 1e-12f);
}
