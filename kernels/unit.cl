/* The unit of floats. */

/* Code light as photos are coded, about: by its root. What is below 0 becomes 0. */
__kernel void unit_code(__global float4 *layer, /* (size.y, size.x) r, g, b, valid; in place */
                        int2 size,              /* run size */
                        float root)             /* of what light is multiplied by */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x >= size.x || y >= size.y)
        return;
    const float4 c = layer[y * size.x + x], light = GREATEST(c, (float4)(0.0f));
    layer[y * size.x + x] = (float4)(root * ROOT(light.x), root * ROOT(light.y), root * ROOT(light.z), c.w);
}
