/* What of layers nobody sees. */

/* Weights of fields that are less than a share of their sum become negative. */
__kernel void hidden_mark(__global float4 *fields,      /* one after the other: (box.w, box.z) each; w: weight */
                          __global const int8 *boxes,   /* (count) box on the working grid; s4: begin in fields */
                          int count,
                          int4 part,   /* of the working grid: run size */
                          float share) /* below which they are hidden */
{
    const int2 p = (int2)(get_global_id(0), get_global_id(1)) + part.xy;
    if (p.x >= part.x + part.z || p.y >= part.y + part.w)
        return;
    float least = 0.0f;
    for (int k = 0; k < count; ++k) {
        const int at = box_index(p, boxes[k].lo);
        least += at < 0 ? 0.0f : share * fields[boxes[k].s4 + at].w;
    }
    for (int k = 0; k < count; ++k) {
        const int at = box_index(p, boxes[k].lo);
        __global float4 *field = fields + boxes[k].s4 + at;
        if (at >= 0)
            field->w -= field->w > least ? least * least / field->w : least; /* hardly less where much is left */
    }
}
