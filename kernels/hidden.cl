/* What of layers nobody sees. */

/* Pixels of a row that a work item takes: where the boxes lie is looked up once for all of them. */
#define HIDDEN_CHUNK 8

/* What a box has of a row's columns from `left` up to `right`: from `first` up to `end`, none beside the box; and its
   values, by columns of the grid. */
typedef struct {
    __global float4 *row;
    int first, end;
} hidden_columns;

static inline hidden_columns hidden_within(__global float4 *fields, int8 box, int left, int right, int y) {
    const int down = y - box.s1, first = GREATEST(left, box.s0);
    const int end = down >= 0 && down < box.s3 ? LEAST(right, box.s0 + box.s2) : first;
    return (hidden_columns){fields + box.s4 + down * box.s2 - box.s0, first, end};
}

/* Weights of fields that are less than a share of their sum become negative; those that are stay so. */
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
        const hidden_columns its = hidden_within(fields, boxes[k], left, right, y);
        for (int x = its.first; x < its.end; ++x)
            least[x - left] += share * GREATEST(its.row[x].w, 0.0f);
    }
    for (int k = 0; k < count; ++k) {
        const hidden_columns its = hidden_within(fields, boxes[k], left, right, y);
        for (int x = its.first; x < its.end; ++x) {
            const float w = its.row[x].w, low = least[x - left];
            its.row[x].w = w - (w > low ? low * low / w : low); /* hardly less where much is left */
        }
    }
}
