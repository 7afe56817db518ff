/* What photos show white. */

/* Every so many-th pixel of a layer, counted from the grid's corner. */
__kernel void saturation_pick(__global const float4 *layer, /* (box.w, box.z) r, g, b, valid */
                              int4 box,                     /* place on the working grid */
                              int every,
                              int4 place,                   /* of the result among these pixels, run size */
                              __global float4 *picked)      /* (place.w, place.z) */
{
    const int i = get_global_id(0), j = get_global_id(1);
    if (i >= place.z || j >= place.w)
        return;
    const int x = (i + place.x) * every - box.x, y = (j + place.y) * every - box.y;
    picked[j * place.z + i] = layer[y * box.z + x];
}
