// Render a picture of a RadianceField: a thread a pixel, samples x samples rays each. Below wgsl/harmonics.wgsl.
//
//   slots    an int32 per cell of the tree. From 0: number of the child, a node of the next level; -1: empty; below:
//            a leaf with row -2 - slot. Cell (x, y, z) of a node is at first + (node << 3 bits) + x-major number
//   top      two int32 per cell of a grid of the first levels, z fastest: a slot, and the level at which it was found
//   texels   four float32 each, TEXELS per row: red, green, blue of the first coefficient and the density per world
//            unit; then red, green, blue of the second, of the third, ..., without gaps
//   stops    a float32 per pixel, if hasStops: the distance at which its ray ends, in world units
//   looks    three float32 per ray, if hasLooks: its unit direction in the world, which a lens has bent
//   out      five float32 per pixel: all colours, then all alphas, then all depths
//
// Positions are in cells of the last level, relative to the integer `anchor`, the cell of the box that is nearest to
// the camera: float32 is exact where cells look large. Distances count from where a ray enters the box.
@group(0) @binding(0) var<storage, read> slots: array<i32>;
@group(0) @binding(1) var<storage, read> top: array<vec2i>;
@group(0) @binding(2) var<storage, read> texels: array<vec4f>;
@group(0) @binding(3) var<storage, read> stops: array<f32>;
@group(0) @binding(4) var<storage, read> looks: array<f32>;
@group(0) @binding(5) var<storage, read_write> out: array<f32>;
@group(0) @binding(6) var<uniform> view: View;

override BASIS: i32 = 1;         // functions of the basis; 0: RGBA
override TEXELS: i32 = 1;        // 1 + 3 ceil((functions - 1) / 4)
override SMOOTH: bool = false;   // interpolate between the centres of cells

struct View {
    eye: vec4f,         // where the pixel rays start without their slopes; w: depth of that plane before the camera
    right: vec4f,       // the camera's axes in the world; w: focal length along x, in pixels
    up: vec4f,          // w: focal length along y
    forward: vec4f,     // w: x of the optical axis, in pixels
    turn: array<vec4f, 3>,  // rows of the matrix from directions in the world to cells; w of the first: y of the axis
    norm: vec4f,        // one over the lengths of these rows; w: the transmittance at which a ray ends
    low: vec4f,         // the box around all leaves
    high: vec4f,
    background: vec4f,  // w: 0 for none
    anchor: vec4i,
    first: vec4i,       // the first and the last cell of the box
    last: vec4i,
    size: vec4u,        // width, height, samples along an edge of a pixel, tiles along x
    has: vec4u,         // hasStops, hasLooks
    tree: vec4u,        // bits of the grid `top`, bits of a position below its cells, edge of the tree
    levels: array<vec4i, 32>,  // of each level of the tree: first, bits, bits of a position below its cells
}

struct Ray {
    start: vec3f,   // where it enters the box
    along: vec3f,   // cells per world unit
    from_eye: f32,  // distance from the camera to `start`, in world units
    end: f32,       // distance from `start` to its end
    own: vec3f,     // unit direction in the field's own axes
}

struct Sums {
    colour: vec3f,
    alpha: f32,    // the sum of the weights, from which `colour` and `far` are made, too
    through: f32,  // the transmittance
    far: f32,      // opacity times distance
}

struct Cell {
    slot: i32,
    corner: vec3i,
    width: i32,
}

fn cellAt(place: vec3i) -> Cell {
    let at = vec3u(place);
    let high = at >> vec3u(view.tree.y);
    let found = top[(high.x << (2u * view.tree.x)) | (high.y << view.tree.x) | high.z];
    var slot = found.x;
    var level = found.y;
    while slot >= 0 {
        level++;
        let own = view.levels[level];
        let bits = u32(own.y);
        let part = (at >> vec3u(u32(own.z))) & vec3u((1u << bits) - 1u);
        slot = slots[u32(own.x) + (u32(slot) << (3u * bits)) + ((part.x << (2u * bits)) | (part.y << bits) | part.z)];
    }
    let below = u32(view.levels[level].z);
    return Cell(slot, vec3i((at >> vec3u(below)) << vec3u(below)), 1 << below);
}

// The sums of a row's coefficients times the basis. first: red, green and blue of its first coefficient.
fn sumOf(row: i32, first: vec3f, basis: ptr<function, Harmonics>) -> vec3f {
    var sum = (*basis).f[0] * first;
    for (var i = 1; i < TEXELS; i += 3) {
        let at = TEXELS * row + i;
        let k = (4 * i - 1) / 3;
        let a = texels[at];
        let b = texels[at + 1];
        let c = texels[at + 2];
        sum += (*basis).f[k] * a.rgb + (*basis).f[k + 1] * vec3f(a.a, b.rg);
        sum += (*basis).f[k + 2] * vec3f(b.ba, c.r) + (*basis).f[k + 3] * c.gba;
    }
    return sum;
}

fn rayOf(column: u32, row: u32, part: vec2u, stop: f32) -> Ray {
    let samples = view.size.z;
    var look: vec3f;
    var start = view.eye.xyz;
    var before = 0.0;
    if view.has.y != 0u {
        let at = 3u * ((samples * row + part.y) * samples * view.size.x + samples * column + part.x);
        look = vec3f(looks[at], looks[at + 1u], looks[at + 2u]);
    } else {
        let pixel = vec2f(f32(column), f32(row)) + (vec2f(part) + 0.5) / f32(samples);
        let x = (pixel.x - view.forward.w) / view.right.w;
        let y = (view.turn[0].w - pixel.y) / view.up.w;
        let aside = x * view.right.xyz + y * view.up.xyz;
        look = aside + view.forward.xyz;
        let long = length(look);
        look /= long;
        start += view.eye.w * turned(aside);
        before = view.eye.w * long;
    }
    let along = turned(look);
    // Replace components near 0 (rays parallel to an axis), to avoid a division by 0.
    let d = select(along, vec3f(1e-12), abs(along) < vec3f(1e-12));
    let one = (view.low.xyz - start) / d;
    let other = (view.high.xyz - start) / d;
    let near = min(one, other);
    let away = max(one, other);
    let enters = max(max(near.x, near.y), max(near.z, 0.0));
    let leaves = min(min(away.x, away.y), min(away.z, stop - before));
    return Ray(start + enters * d, d, before + enters, leaves - enters, along * view.norm.xyz);
}

fn turned(direction: vec3f) -> vec3f {
    return vec3f(
        dot(direction, view.turn[0].xyz), dot(direction, view.turn[1].xyz), dot(direction, view.turn[2].xyz));
}

// The cell that contains the place at t, within these bounds.
fn containing(ray: Ray, t: f32, first: vec3i, last: vec3i) -> vec3i {
    return clamp(vec3i(floor(ray.start + t * ray.along)) + view.anchor.xyz, first, last);
}

// Where a ray leaves a cube of cells, along each axis.
fn exitsOf(ray: Ray, corner: vec3i, width: i32) -> vec3f {
    let upward = select(vec3f(0.0), vec3f(1.0), ray.along > vec3f(0.0));
    return (vec3f(corner - view.anchor.xyz) + upward * f32(width) - ray.start) / ray.along;
}

// The cell that a ray enters when it leaves a cube of cells at t. It is computed by number: a small step instead could
// stall the ray or skip a cell by rounding. w: the axis of the face between them.
fn nextOf(ray: Ray, corner: vec3i, width: i32, exits: vec3f, t: f32) -> vec4i {
    let axis = select(select(2, 1, exits.y <= exits.z), 0, exits.x <= exits.y && exits.x <= exits.z);
    var cell = containing(ray, t, corner, corner + width - 1);
    cell[axis] = select(corner[axis] - 1, corner[axis] + width, ray.along[axis] > 0.0);
    return vec4i(cell, axis);
}

// 1 - exp(-x) and 1 - (1 + x) exp(-x), also for small x, where float32 would lose the digits of the differences.
fn lost(x: f32) -> vec2f {
    if x > 0.2 {
        let kept = exp(-x);
        return vec2f(1.0 - kept, 1.0 - kept - x * kept);
    }
    let first = x * (1.0 - x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0))));
    return vec2f(first, x * x * (1.0 / 2.0 - x * (1.0 / 3.0 - x * (1.0 / 8.0 - x * (1.0 / 30.0 - x / 144.0)))));
}

fn march(ray: Ray, basis: ptr<function, Harmonics>) -> Sums {
    var sums = Sums(vec3f(0.0), 0.0, 1.0, 0.0);
    let first = view.first.xyz;
    let last = view.last.xyz;
    var t = 0.0;
    var place = containing(ray, t, first, last);
    while t < ray.end && sums.through >= view.norm.w {
        let cell = cellAt(place);
        let exits = exitsOf(ray, cell.corner, cell.width);
        let next = max(min(exits.x, min(exits.y, exits.z)), t);
        if cell.slot < -1 {
            let row = -2 - cell.slot;
            let texel = texels[TEXELS * row];
            let part = lost(texel.a * (min(next, ray.end) - t));
            let weight = sums.through * part.x;
            sums.colour += weight * sigmoid(sumOf(row, texel.rgb, basis));
            sums.alpha += weight;
            // The mean distance, within the cell, at which light is absorbed there.
            sums.far += weight * (ray.from_eye + t) + sums.through * part.y / max(texel.a, 1e-30);
            sums.through *= 1.0 - part.x;
        }
        t = next;
        let step = nextOf(ray, cell.corner, cell.width, exits, t);
        place = step.xyz;
        if place[step.w] < first[step.w] || place[step.w] > last[step.w] { break; }
    }
    return sums;
}

// The sums of the coefficients times the density, and the density, of the cell whose centre is this corner of a cube.
fn cornerAt(place: vec3i, basis: ptr<function, Harmonics>) -> vec4f {
    if any(place < vec3i(0)) || any(place >= vec3i(i32(view.tree.z))) { return vec4f(0.0); }
    let slot = cellAt(place).slot;
    if slot >= -1 { return vec4f(0.0); }
    let row = -2 - slot;
    let texel = texels[TEXELS * row];
    return vec4f(texel.a * sumOf(row, texel.rgb, basis), texel.a);
}

// The same between the centres of cells: density is trilinear, coefficients are weighted by it. Two Gauss points
// integrate the density of a cube exactly. Positions count from the centre of the first cell.
fn marchSmooth(ray: Ray, basis: ptr<function, Harmonics>) -> Sums {
    var sums = Sums(vec3f(0.0), 0.0, 1.0, 0.0);
    let first = view.first.xyz;
    let last = view.last.xyz;
    let edge = i32(view.tree.z);
    var t = 0.0;
    var place = containing(ray, t, first, last);
    while t < ray.end && sums.through >= view.norm.w {
        var corner = place;
        var width = 1;
        if all(place >= vec3i(0)) && all(place < vec3i(edge)) {
            let cell = cellAt(place);
            let inside = place - cell.corner;
            if cell.slot == -1 && max(inside.x, max(inside.y, inside.z)) < cell.width - 1 {
                corner = cell.corner;  // all cubes between the centres in an empty cell of the tree
                width = cell.width - 1;
            }
        }
        let exits = exitsOf(ray, corner, width);
        let next = max(min(exits.x, min(exits.y, exits.z)), t);
        if width == 1 {
            var corners: array<vec4f, 8>;
            for (var i = 0; i < 8; i++) {
                corners[i] = cornerAt(corner + vec3i(i >> 2, (i >> 1) & 1, i & 1), basis);
            }
            let long = min(next, ray.end) - t;
            for (var point = 0; point < 2; point++) {
                let at = t + long * select(0.7886751345948129, 0.21132486540518713, point == 0);
                let f = ray.start + at * ray.along - vec3f(corner - view.anchor.xyz);
                let x0 = mix(mix(corners[0], corners[1], f.z), mix(corners[2], corners[3], f.z), f.y);
                let x1 = mix(mix(corners[4], corners[5], f.z), mix(corners[6], corners[7], f.z), f.y);
                let found = mix(x0, x1, f.x);
                if found.a > 0.0 {
                    let part = lost(found.a * 0.5 * long).x;
                    let weight = sums.through * part;
                    sums.colour += weight * sigmoid(found.rgb / found.a);
                    sums.alpha += weight;
                    sums.far += weight * (ray.from_eye + at);
                    sums.through *= 1.0 - part;
                }
            }
        }
        t = next;
        let step = nextOf(ray, corner, width, exits, t);
        place = step.xyz;
        if place[step.w] < first[step.w] || place[step.w] > last[step.w] { break; }
    }
    return sums;
}

@compute @workgroup_size(8, 8) fn render(
    @builtin(workgroup_id) group: vec3u,
    @builtin(num_workgroups) count: vec3u,
    @builtin(local_invocation_id) local: vec3u
) {
    let tile = group.x + group.y * count.x;
    let column = 8u * (tile % view.size.w) + local.x;
    let row = 8u * (tile / view.size.w) + local.y;
    if column >= view.size.x || row >= view.size.y { return; }
    let pixel = row * view.size.x + column;
    let pixels = view.size.x * view.size.y;
    let samples = view.size.z;
    var stop = 3e38;
    if view.has.x != 0u { stop = stops[pixel]; }
    var colour = vec3f(0.0);
    var alpha = 0.0;
    var far = 0.0;
    for (var i = 0u; i < samples * samples; i++) {
        let ray = rayOf(column, row, vec2u(i % samples, i / samples), stop);
        var basis = harmonics(ray.own, BASIS);
        if BASIS == 0 { basis.f[0] = 1.0; }
        var sums: Sums;
        if SMOOTH { sums = marchSmooth(ray, &basis); } else { sums = march(ray, &basis); }
        colour += sums.colour + view.background.w * (1.0 - sums.alpha) * view.background.rgb;
        alpha += sums.alpha;
        far += sums.far;
    }
    let rays = f32(samples * samples);
    out[3u * pixel] = colour.r / rays;
    out[3u * pixel + 1u] = colour.g / rays;
    out[3u * pixel + 2u] = colour.b / rays;
    out[3u * pixels + pixel] = alpha / rays;
    out[4u * pixels + pixel] = select(0.0, far / alpha, alpha > 0.0);
}
