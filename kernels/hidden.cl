/* What of layers nobody sees. */

/* Pixels of a row that a work item takes: where the boxes lie is looked up once for all of them. */
#define HIDDEN_CHUNK 8

/* Weights of fields that are less than a share of their sum become negative. */
__kernel void hidden_mark(__global float4 *fields,    /* one after the other: (box.w, box.z) each; w: weight */
                          __global const int8 *boxes, /* (count) box on the working grid; s4: begin in fields */
                          int count,
                          int4 part,   /* of the working grid: run size, its columns by HIDDEN_CHUNK, rounded up */
                          float share) /* below which they are hidden */
{
    const int left = part.x + (int)get_global_id(0) * HIDDEN_CHUNK, y = part.y + (int)get_global_id(1);
    if (left >= part.x + part.z || y >= part.y + part.w)
        return;
    const int right = LEAST(left + HIDDEN_CHUNK, part.x + part.z);
    float least[HIDDEN_CHUNK];
    for (int i = 0; i < HIDDEN_CHUNK; ++i)
        least[i] = 0.0f;
    for (int k = 0; k < count; ++k) {
        const int8 box = boxes[k];
        if (y < box.s1 || y >= box.s1 + box.s3)
            continue;
        __global const float4 *row = fields + box.s4 + (y - box.s1) * box.s2 - box.s0;
        const int first = GREATEST(left, box.s0), end = LEAST(right, box.s0 + box.s2);
        for (int x = first; x < end; ++x)
            least[x - left] += share * row[x].w;
    }
    for (int k = 0; k < count; ++k) {
        const int8 box = boxes[k];
        if (y < box.s1 || y >= box.s1 + box.s3)
            continue;
        __global float4 *row = fields + box.s4 + (y - box.s1) * box.s2 - box.s0;
        const int first = GREATEST(left, box.s0), end = LEAST(right, box.s0 + box.s2);
        for (int x = first; x < end; ++x) {
            const float w = row[x].w, its = least[x - left];
            row[x].w = w - (w > its ? its * its / w : its); /* hardly less where much is left */
        }
    }
}
