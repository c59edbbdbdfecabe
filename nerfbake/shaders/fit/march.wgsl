// The rays of a view through the bricks, twice: first what each ray sees, then, with `back`, what its pixel asks of the
// cells that it meets. A thread for each ray. WGSL. Paste rays.wgsl and grid.wgsl above this file.
//
// The first pass keeps sums over the whole ray. In the second one, what lies behind a cell is the sum over the ray minus
// that up to the cell, so no list of cells is kept.
//
//   first    the number of each brick's first cell, in the buffer of cells.wgsl
//   painted  colour and density of each cell
//   sums     eight int32 for each cell: colour (3), weight, step of the density, curvature, largest weight, blame
//   corners  if densities are interpolated: each corner's raw density, mean curvature, and two sums
//   cornersOf  eight uint32 for each cell: its corners 4 dx + 2 dy + dz
override back = false;
override smoothed = false;  // densities are interpolated
const OPAQUE = 0.01;  // transmittance below which a ray stops
const MOST_STEPS = 65536;
const MARGIN = 0.02;  // on the scale of places along a ray: light this close to a known surface is right
const BEHIND = 0.03;  // most that light behind the margin counts

struct Corner {
    raw: f32,
    mean: f32,
    asked: atomic<i32>,
    curvature: atomic<i32>,
}

@group(1) @binding(0) var<storage, read> bricks: array<vec2u>;
@group(1) @binding(4) var<storage, read> painted: array<vec4f>;
@group(1) @binding(8) var<storage, read_write> sums: array<atomic<i32>>;
@group(1) @binding(9) var<storage, read> cornersOf: array<u32>;
@group(1) @binding(10) var<storage, read_write> corners: array<Corner>;

struct Density {
    value: f32,  // in 1/world unit
    slope: f32,  // of the density per width of a cell, by the raw density
    place: vec3f,  // in the cell, 0 to 1
}

// Where a ray enters and leaves the cube around a shell.
fn partInCube(shell: i32, direction: vec3f) -> vec2f {
    let along = steady(direction / view.shells[shell].size.xyz);
    let one = -view.shells[shell].place.xyz / along;
    let other = (f32(8u * view.edge) - view.shells[shell].place.xyz) / along;
    let near = min(one, other);
    let far = max(one, other);
    return vec2f(max(max(near.x, near.y), max(near.z, 0.0)), min(far.x, min(far.y, far.z)));
}

// Replace components near 0 (rays parallel to an axis), to avoid a division by 0.
fn steady(direction: vec3f) -> vec3f {
    return select(direction, vec3f(1e-12), abs(direction) < vec3f(1e-12));
}

// A place along a ray, -2 at the camera to 2 at infinity; near the focus about log(t / focus).
fn placeOf(t: f32) -> f32 {
    return 2.0 * (t - view.losses.w) / (t + view.losses.w);
}

// How wrong light is that comes from so far behind a known surface, or before it (negative).
fn awayFrom(apart: f32) -> f32 {
    return select(clamp(apart - MARGIN, 0.0, BEHIND), max(-apart - MARGIN, 0.0), apart < 0.0);
}

fn densityAt(row: u32, place: vec3f, perWidth: f32) -> Density {
    let p = clamp(place, vec3f(0.0), vec3f(1.0));
    var raw: array<f32, 8>;
    for (var k = 0u; k < 8u; k++) { raw[k] = corners[cornersOf[8u * row + k]].raw; }
    let low = mix(mix(raw[0], raw[1], p.z), mix(raw[2], raw[3], p.z), p.y);
    let high = mix(mix(raw[4], raw[5], p.z), mix(raw[6], raw[7], p.z), p.y);
    let between = mix(low, high, p.x);
    if between > 1.0 { return Density(between * perWidth, 1.0, p); }
    let thin = exp(between - 1.0);
    return Density(thin * perWidth, thin, p);
}

fn addToCell(row: u32, k: u32, value: f32) {
    let steps = i32(round(value * view.limits.z));
    if steps != 0 { atomicAdd(&sums[8u * row + k], steps); }
}

fn addToCorners(row: u32, p: vec3f, asked: f32) {
    for (var k = 0u; k < 8u; k++) {
        let side = select(1.0 - p, p, vec3<bool>((k & 4u) != 0u, (k & 2u) != 0u, (k & 1u) != 0u));
        let steps = i32(round(asked * side.x * side.y * side.z * view.limits.z));
        if steps != 0 { atomicAdd(&corners[cornersOf[8u * row + k]].asked, steps); }
    }
}

@compute @workgroup_size(64)
fn march(@builtin(global_invocation_id) id: vec3u, @builtin(num_workgroups) groups: vec3u) {
    let ray = threadOf(id, groups);
    let count = view.samples * view.samples;
    let pixel = ray / count;
    if pixel >= view.pixels { return; }
    let direction = directionOf(pixel, ray % count);
    let distorted = view.losses.z > 0.0;
    let own = select(1u, 2u, distorted) * ray;
    let surfaceAt = bitcast<f32>(pixels[4u * pixel + 3u]);
    let known = view.depth > 0.0 && surfaceAt > 0.0;
    let surface = placeOf(surfaceAt);
    let edge = 8 * i32(view.edge);
    let shells = i32(view.shellCount);

    // Of the whole ray, and of its pixel.
    var whole = vec4f(0.0);
    var wholeDepth = vec3f(0.0);
    var residual = vec4f(0.0);
    var wanted = vec3f(0.0);
    if back {
        whole = rays[own];
        if distorted { wholeDepth = rays[own + 1u].xyz; }
        residual = residuals[pixel];
        wanted = targetOf(pixel).rgb;
    }
    let blame = abs(residual.r) + abs(residual.g) + abs(residual.b);

    // Up to the current cell: transmittance, colour, and the sums of weight times depth, of weight times slope, and of
    // weight times what the depth loss counts.
    var through = 1.0;
    var colour = vec3f(0.0);
    var depths = 0.0;
    var slopes = 0.0;
    var aways = 0.0;
    // The shells from the outermost to the innermost one that the ray enters, and back.
    var deepest = shells;
    for (var shell = shells - 1; shell >= 0; shell--) {
        let within = partInCube(shell, direction);
        if within.x >= within.y { break; }
        deepest = shell;
    }
    let parts = select(0, 2 * (shells - deepest) - 1, deepest < shells);
    for (var part = 0; part < parts && through > 0.0; part++) {
        let inward = part < shells - 1 - deepest;
        let shell = select(2 * deepest + part - shells + 1, shells - 1 - part, inward);
        let within = partInCube(shell, direction);
        var t = within.x;
        var end = within.y;
        if inward {
            end = partInCube(shell - 1, direction).x;
        } else if shell != deepest {
            t = partInCube(shell - 1, direction).y;
        }
        let width = view.shells[shell].size.w;
        let d = steady(direction / view.shells[shell].size.xyz);
        let o = view.shells[shell].place.xyz;
        let inverse = 1.0 / d;
        let upward = d > vec3f(0.0);
        var cell = clamp(vec3i(floor(o + t * d)), vec3i(0), vec3i(edge - 1));
        var at = cell >> vec3u(3u);
        var brick = brickAt(shell, at);
        var exact = 3;  // after a wide cell, the only axis along which the last bit of the place is valid; 3: all axes
        for (var step = 0; step < MOST_STEPS && t < end; step++) {
            if brick < 0 {
                // Skip the empty bricks up to the known distance, in all directions.
                let away = max(-brick, 1);
                let low = (at - away + 1) * 8;
                let size = (2 * away - 1) * 8;
                let exits = (vec3f(select(low, low + size, upward)) - o) * inverse;
                t = max(min(exits.x, min(exits.y, exits.z)), t);
                let axis = select(select(2, 1, exits.y <= exits.z), 0, exits.x <= exits.y && exits.x <= exits.z);
                cell = clamp(vec3i(floor(o + t * d)), low, low + size - 1);
                cell[axis] = select(low[axis] - 1, low[axis] + size, upward[axis]);
                exact = 3;
            } else {
                var slot = slotAt(brick, cell);
                if exact < 3 && (slot & 1) == 0 {
                    let here = clamp(vec3i(floor(o + t * d)), cell & vec3i(~1), cell | vec3i(1));
                    let kept = cell[exact];
                    cell = here;
                    cell[exact] = kept;
                    exact = 3;
                    slot = slotAt(brick, cell);
                }
                let wide = slot & 1;
                let low = cell & vec3i(~wide);
                let exits = (vec3f(select(low, low + 1 + wide, upward)) - o) * inverse;
                let ahead = max(min(exits.x, min(exits.y, exits.z)), t);
                if slot >= 0 {
                    let row = bricks[brick].x + u32(slot >> 1u);
                    let seen = painted[row];
                    let length = ahead - t;
                    var density = Density(seen.a, 1.0, vec3f(0.0));
                    if smoothed {
                        density = densityAt(row, o + (t + 0.5 * length) * d - vec3f(low), 1.0 / width);
                    }
                    var behind = through * exp(-density.value * length);
                    if behind < OPAQUE { behind = 0.0; }  // the last cell absorbs all remaining light
                    let weight = through - behind;
                    colour += weight * seen.rgb;
                    // Lengths are in widths of the cell, like its density.
                    let long = length * (1.0 - 0.5 * f32(wide)) / width * density.slope;
                    var asked = 0.0;
                    if distorted {
                        let focus = view.losses.w;
                        let middle = t + 0.5 * length;
                        let depth = placeOf(middle);
                        let away = select(0.0, awayFrom(depth - surface), known);
                        let scale = (2.0 - depth) * (2.0 - depth) / (4.0 * focus);  // the slope of the places
                        let before = 1.0 - through;
                        aways += weight * away;
                        if back {
                            let after = behind - whole.a;
                            let later = wholeDepth.x - depths - weight * depth;
                            let slope = 2.0 * (depth * (before - after) - depths + later)
                                + 2.0 / 3.0 * weight * length * scale;
                            slopes += weight * slope;
                            let rest = select(wholeDepth.y - slopes, 0.0, behind == 0.0);
                            asked = -view.losses.z * long * (behind * slope - rest);
                            let others = select(wholeDepth.z - aways, 0.0, behind == 0.0);
                            asked -= view.depth * long * (behind * away - others);
                        } else {
                            slopes += weight * (4.0 * (depth * before - depths) + 2.0 / 3.0 * weight * length * scale);
                        }
                        depths += weight * depth;
                    }
                    if back {
                        // Nothing is behind the last cell; the difference may have a last bit.
                        let beyond = select(whole.rgb - colour, vec3f(0.0), behind == 0.0);
                        let j = long * (behind * seen.rgb - beyond);
                        let ja = long * whole.a;
                        asked += dot(j, residual.rgb) + view.losses.x * ja * residual.a;
                        let change = weight * (residual.rgb + view.losses.y * (wanted - seen.rgb));
                        addToCell(row, 0u, change.r);
                        addToCell(row, 1u, change.g);
                        addToCell(row, 2u, change.b);
                        addToCell(row, 3u, weight);
                        if smoothed {
                            addToCorners(row, density.place, asked);
                        } else {
                            addToCell(row, 4u, asked);
                        }
                        // A curvature is not rounded to 0, because the mean of a cell that was met once is another,
                        // unless it is only an error of the difference.
                        let curvature = dot(j, j) + view.losses.x * ja * ja;
                        let least = select(0, 1, curvature > 1e-12);
                        let curved = max(i32(round(curvature * view.limits.z)), least);
                        if curved != 0 { atomicAdd(&sums[8u * row + 5u], curved); }
                        atomicMax(&sums[8u * row + 6u], i32(round(weight * view.limits.z)));
                        addToCell(row, 7u, weight * blame);
                    }
                    through = behind;
                    if through == 0.0 { break; }
                }
                t = ahead;
                let axis = select(select(2, 1, exits.y <= exits.z), 0, exits.x <= exits.y && exits.x <= exits.z);
                cell[axis] = select(low[axis] - 1, low[axis] + 1 + wide, upward[axis]);
                exact = select(3, axis, wide == 1);
            }
            if any(cell < vec3i(0)) || any(cell >= vec3i(edge)) { break; }
            let next = cell >> vec3u(3u);
            if any(next != at) {
                at = next;
                brick = brickAt(shell, at);
            }
        }
    }
    if !back {
        rays[own] = vec4f(colour + through * view.background.rgb, through);
        if distorted { rays[own + 1u] = vec4f(depths, slopes, aways, 0.0); }
    }
}
