/* The unit of floats. */

__kernel void unit_scale(__global float4 *layer, /* (size.y, size.x) r, g, b, valid; in place */
                         int2 size,              /* run size */
                         float factor)           /* of r, g and b */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x < size.x && y < size.y)
        layer[y * size.x + x] *= (float4)(factor, factor, factor, 1.0f);
}
