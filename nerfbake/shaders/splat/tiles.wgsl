// The tiles that a splat reaches into. WGSL. Paste view.wgsl above this file.
//
//   boxes  if view.bent: the least x, least y, largest x, largest y of the pixels' centres in each row of tiles, then
//          those in each tile; in pixels of a picture without lens distortion
@group(1) @binding(0) var<storage, read> boxes: array<vec4f>;

// A projected splat: four vec4f in `rows`.
struct Row {
    place: vec4f,   // whole pixels and remainder of x, and of y
    form: vec4f,    // the inverse of its covariance: xx, xy, yy; its opacity
    shade: vec4f,   // colour and depth
    reach: vec4f,   // twice the exponent at which alpha falls below SEEN; 1 / determinant; half width and height
}

fn spanOf(low: f32, high: f32, least: u32, most: u32) -> vec2u {
    let first = max((low - 0.5) / f32(EDGE), f32(least));
    let last = min((high - 0.5) / f32(EDGE), f32(most));
    if !(last >= first) { return vec2u(u32(max(first, 0.0))); }
    return vec2u(u32(first), min(u32(last) + 1u, most));
}

fn isApart(box: vec4f, place: vec2f, half: vec2f) -> bool {
    return any(place + half < box.xy) || any(place - half > box.zw);
}

// How far the ellipse reaches left and right where y is between low and high from its centre.
fn widthBetween(row: Row, low: f32, high: f32) -> vec2f {
    let form = row.form;
    let at = form.y / form.z * row.reach.z;
    let leftmost = clamp(at, low, high);
    let rightmost = clamp(-at, low, high);
    let left = sqrt(max(row.reach.x * form.x - leftmost * leftmost * row.reach.y, 0.0));
    let right = sqrt(max(row.reach.x * form.x - rightmost * rightmost * row.reach.y, 0.0));
    return vec2f(-form.y * leftmost - left, right - form.y * rightmost) / form.x;
}

// The tiles of a row of tiles: first and end; none if they are equal.
fn columnsOf(row: Row, tiles: u32, oblong: bool, across: vec2u) -> vec2u {
    if !oblong { return across; }
    let x = row.place.x + row.place.y;
    let y = row.place.z + row.place.w;
    let top = f32(tiles * EDGE) - y;
    let wide = widthBetween(row, top + 0.5, top + f32(EDGE) - 0.5);
    return spanOf(x + wide.x - PAD, x + wide.y + PAD, 0u, view.columns);
}

// The number of tiles of a splat. They are written from entry `at` on, before entry `end`, if there are any to write.
fn visit(row: Row, number: u32, at: u32, end: u32) -> u32 {
    let place = row.place.xz + row.place.yw;
    let half = row.reach.zw * (1.0 + 1e-6) + PAD;
    var count = 0u;
    if view.bent != 0u {
        for (var down = view.begin; down < view.end; down++) {
            if isApart(boxes[down], place, half) { continue; }
            for (var tile = down * view.columns; tile < (down + 1u) * view.columns; tile++) {
                if isApart(boxes[view.rows + tile], place, half) { continue; }
                if at + count < end { write(at + count, tile, number); }
                count++;
            }
        }
        return count;
    }
    let down = spanOf(place.y - half.y, place.y + half.y, view.begin, view.end);
    let across = spanOf(place.x - half.x, place.x + half.x, 0u, view.columns);
    let oblong = down.y > down.x + 1u && across.y > across.x + 1u;
    for (var tiles = down.x; tiles < down.y; tiles++) {
        let own = columnsOf(row, tiles, oblong, across);
        for (var tile = own.x; tile < own.y; tile++) {
            if at + count < end { write(at + count, tiles * view.columns + tile, number); }
            count++;
        }
    }
    return count;
}
