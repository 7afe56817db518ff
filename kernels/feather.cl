/* Shares of layers by how far each pixel is from where its layer ends and another one goes on. Distances are those of
   whole pixels, exact: down the columns first, then by the lower envelope of parabolas along each row (Meijster,
   Roerdink and Hesselink 2000). Layers are arrays on a box of a grid. */

/* The column of a box that is so many places from its first: beyond its ends it goes on. */
static inline int feather_column(int place, int4 box) {
    return place < 0 ? place + box.z : place >= box.z ? place - box.z : place;
}

/* Squared distance of place x of a row from the nearest border in column `at`, which is `rows` away there. */
static inline long feather_squared(long x, int at, long rows) {
    return (x - at) * (x - at) + rows * rows;
}

/* Mark the pixels of the grid that a layer shows. */
__kernel void feather_mark(__global const float4 *layer, /* (box.w, box.z): colour, valid */
                           int4 box, int4 grid,          /* place, run size; its grid */
                           __global uchar *shown)        /* (grid.y, grid.x): 1 where any layer shows something */
{
    const int x = get_global_id(0), y = get_global_id(1);
    if (x < box.z && y < box.w && layer[y * box.z + x].w > 0.0f)
        shown[(y + box.y) * grid.x + x + box.x] = 1;
}

/* In each column of the box, the rows to the nearest pixel that another layer shows and this one does not. */
__kernel void feather_columns(__global const float4 *layer, int4 box, int4 grid, /* as above; run size: box.z */
                              __global const uchar *shown, /* (grid.y, grid.x) */
                              int far,                     /* more than any distance: where there is none */
                              __global ushort *rows)       /* (box.w, box.z) */
{
    const int x = get_global_id(0);
    if (x >= box.z)
        return;
    int off = far;
    for (int y = 0; y < box.w; ++y) {
        const bool border = layer[y * box.z + x].w <= 0.0f && shown[(y + box.y) * grid.x + x + box.x];
        off = border ? 0 : LEAST(off + 1, far);
        rows[y * box.z + x] = off;
    }
    for (int y = box.w - 2; y >= 0; --y) {
        off = LEAST(off + 1, rows[y * box.z + x]);
        rows[y * box.z + x] = off;
    }
}

/* The distance to the nearest such pixel, 0 where the layer shows nothing; added to those of all. A box that goes once
   around is continued beyond its ends. */
__kernel void feather_distance(__global const float4 *layer, int4 box, int4 grid, /* as above; run size: box.w */
                               __global const ushort *rows,  /* (box.w, box.z), of feather_columns */
                               int beyond,                   /* columns that it is continued by, up to box.z */
                               __global ushort2 *lowest,     /* (box.w, box.z + 2 beyond): a column, and the first
                                                                place in whose reach it is the nearest */
                               __global float *distance,     /* (box.w, box.z) */
                               __global float *total)        /* (grid.y, grid.x) */
{
    const int y = get_global_id(0), places = box.z + 2 * beyond;
    if (y >= box.w)
        return;
    __global const ushort *row = rows + y * box.z;
    __global ushort2 *envelope = lowest + y * places;
    int last = -1, high = 0; /* rows of the last column's */
    int2 top = (int2)(0, 0);
    for (int u = 0; u < places; ++u) {
        const int its = row[feather_column(u - beyond, box)];
        while (last >= 0 && feather_squared(top.y, top.x, high) > feather_squared(top.y, u, its))
            if (--last >= 0) {
                top = convert_int2(envelope[last]);
                high = row[feather_column(top.x - beyond, box)];
            }
        long from = 0;
        if (last >= 0) {
            const long more = feather_squared(u, 0, its) - feather_squared(top.x, 0, high);
            from = 1 + more / (2 * (u - top.x));
        }
        if (from < places) {
            top = (int2)(u, (int)from);
            envelope[++last] = convert_ushort2(top);
            high = its;
        }
    }
    for (int u = places - 1; u >= 0; --u) {
        const int x = u - beyond;
        if (x >= 0 && x < box.z) {
            const int at = y * box.z + x;
            const float d = layer[at].w > 0.0f ? ROOT((float)feather_squared(u, top.x, high)) : 0.0f;
            distance[at] = d;
            total[(y + box.y) * grid.x + x + box.x] += d;
        }
        if (u == top.y && --last >= 0) {
            top = convert_int2(envelope[last]);
            high = row[feather_column(top.x - beyond, box)];
        }
    }
}
