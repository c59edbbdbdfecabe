// Pull one coefficient of each channel, or the densities, of all cells towards those of their neighbours: see
// kernels/fit/ties.py. `gather` copies the values of all parts; then `tie` changes them and reads only the copy, so a
// neighbour may be in another part, and the order of the cells does not matter. A workgroup for each brick. WGSL.
// Paste cells.wgsl and grid.wgsl above this file.
//
//   painted  the copy: red, green, blue, and the mean weight; or the density per width of a cell that is not wide, 0, 0,
//            and the mean curvature
//   means    as in step.wgsl
const SIDES = 6u;
const NOTHING = 1e-9;  // evidence of a cell that no ray has met, so that nothing is divided by 0

@group(1) @binding(11) var<storage, read_write> means: array<vec2f>;

@compute @workgroup_size(64)
fn gather(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let number = part.x + group.y * groups.x + group.x;
    if number >= part.y { return; }
    let brick = brickOf(number);
    let channel = u32(B) * brick.count;
    for (var cell = lane; cell < brick.count; cell += 64u) {
        let row = brick.first + cell;
        let at = brick.start + view.coefficient * brick.count + cell;
        if view.coefficient == u32(B) {
            let density = values[brick.start + 3u * channel + cell] / f32(1u + (placeOf(row) & 1u));
            painted[row] = vec4f(density, 0.0, 0.0, means[row].x);
        } else {
            painted[row] = vec4f(values[at], values[at + channel], values[at + 2u * channel], means[row].y);
        }
    }
}

@compute @workgroup_size(64)
fn tie(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let number = part.x + group.y * groups.x + group.x;
    if number >= part.y { return; }
    let brick = brickOf(number);
    for (var cell = lane; cell < brick.count; cell += 64u) { tieCell(brick, cell); }
}

fn tieCell(brick: Brick, cell: u32) {
    let row = brick.first + cell;
    let place = placeOf(row);
    let own = painted[row];
    let dense = view.coefficient == u32(B);
    var found = vec3f(0.0);
    var total = 0.0;
    for (var side = 0u; side < SIDES; side++) {
        let other = neighbourOf(brick, place, side);
        if other >= 0 {
            let near = painted[other];
            let weight = select(near.w, view.tieEdge / (view.tieEdge + abs(near.x - own.x)), dense);
            found += weight * near.xyz;
            total += weight;
        }
    }
    if total <= 0.0 { return; }
    let strength = select(view.tie, view.tie * min(total, 1.0), dense);
    let moved = own.xyz + strength / (strength + own.w + NOTHING) * (found / total - own.xyz);
    let channel = u32(B) * brick.count;
    if dense {
        values[brick.start + 3u * channel + cell] = moved.x * f32(1u + (place & 1u));
    } else {
        let at = brick.start + view.coefficient * brick.count + cell;
        values[at] = moved.x;
        values[at + channel] = moved.y;
        values[at + 2u * channel] = moved.z;
    }
}

// The number of the cell at a side of a cell, 2 axis + (0 before it, 1 behind it), or -1.
fn neighbourOf(brick: Brick, place: u32, side: u32) -> i32 {
    let corner = vec3i(vec3u(brick.place >> 16u, brick.place >> 8u, brick.place) & vec3u(255u)) * 8;
    var at = corner + vec3i(vec3u(place >> 7u, place >> 4u, place >> 1u) & vec3u(7u));
    at[side >> 1u] += select(-1, 1 + i32(place & 1u), (side & 1u) == 1u);
    if any(at < vec3i(0)) || any(at >= vec3i(8 * i32(view.edge))) { return -1; }
    let other = brickAt(i32(brick.place >> 24u), at >> vec3u(3u));
    if other < 0 { return -1; }
    let slot = slotAt(other, at);
    if slot < 0 { return -1; }
    return i32(bricks[other].x) + (slot >> 1u);
}
