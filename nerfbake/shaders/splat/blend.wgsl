// Blend the splats of each tile front to back. A workgroup for each tile, a thread for each pixel. WGSL.
// Paste view.wgsl above this file.
//
//   rows     as in project.wgsl
//   firsts   as in spread.wgsl
//   entries  as there, sorted by tile
//   places   vec2f for each pixel, if view.bent: where its centre is without lens distortion, from its tile's corner
//   out      five float32 for each pixel: all colours, then all alphas, then all depths
const MOST_ALPHA = 0.99;
const LEAST_TRANSMITTANCE = 1e-4;
const CHUNK = 256u;  // splats that are loaded at a time

@group(1) @binding(0) var<storage, read> rows: array<vec4f>;
@group(1) @binding(1) var<storage, read> firsts: array<u32>;
@group(1) @binding(2) var<storage, read> entries: array<vec2u>;
@group(1) @binding(3) var<storage, read> places: array<vec2f>;
@group(1) @binding(4) var<storage, read_write> out: array<f32>;

var<workgroup> near: array<vec4f, 768>;    // of each splat: place from the tile's corner; form; shade
var<workgroup> limits: vec2u;              // the tile's entries
var<workgroup> lastOpen: atomic<u32>;      // the number of the last chunk after which a pixel is open, from 1
var<workgroup> isOpen: u32;

// The first entry with this tile or a later one.
fn firstOf(tile: u32) -> u32 {
    var low = 0u;
    var high = min(firsts[view.total], view.room);
    while low < high {
        let middle = low + (high - low) / 2u;
        if entries[middle].x < tile { low = middle + 1u; } else { high = middle; }
    }
    return low;
}

// e^x for x from -6 to 0, with a relative error below 3e-6; at most e^-6 for x below. As in kernels/splat/blend.py.
fn shortExp(x: f32) -> f32 {
    let t = clamp(x, -6.0, 0.0) * 0.0625 + 0.1875;
    var series = (1.0 / 120.0) * t + 1.0 / 24.0;
    series = series * t + 1.0 / 6.0;
    series = series * t + 0.5;
    series = series * t + 1.0;
    series = (series * t + 1.0) * 0.8290291181804004;
    series *= series;
    series *= series;
    series *= series;
    return series * series;
}

@compute @workgroup_size(256)
fn blend(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let tile = group.y * groups.x + group.x;
    if tile >= (view.end - view.begin) * view.columns { return; }
    let corner = EDGE * vec2u(tile % view.columns, tile / view.columns + view.begin);
    let inside = vec2u(lane % EDGE, lane / EDGE);
    let pixel = corner + inside;
    let shown = pixel.x < view.width && pixel.y < view.height;
    let number = pixel.y * view.width + pixel.x;
    var place = vec2f(inside) + 0.5;
    if view.bent != 0u && shown { place = places[number]; }
    if lane < 2u { limits[lane] = firstOf(tile + lane); }
    // WGSL says that workgroup memory starts at 0; with wgpu 0.32.0 on lavapipe it has what was there before.
    if lane == 0u { atomicStore(&lastOpen, 0u); }
    let begin = workgroupUniformLoad(&limits).x;
    let end = workgroupUniformLoad(&limits).y;

    var live = select(0.0, 1.0, shown);
    var left = 1.0;
    var sum = vec4f(0.0);
    var chunk = 0u;
    for (var first = begin; first < end; first += CHUNK) {
        let count = min(CHUNK, end - first);
        if lane < count {
            let row = 4u * entries[first + lane].y;
            let own = rows[row];
            near[3u * lane] = vec4f((own.xz - vec2f(corner)) + own.yw, 0.0, 0.0);
            near[3u * lane + 1u] = rows[row + 1u];
            near[3u * lane + 2u] = rows[row + 2u];
        }
        workgroupBarrier();
        for (var k = 0u; k < count && live > 0.0; k++) {
            let d = place - near[3u * k].xy;
            let form = near[3u * k + 1u];
            let exponent = -0.5 * (form.x * d.x * d.x + form.z * d.y * d.y) - form.y * d.x * d.y;
            let alpha = min(form.w * shortExp(exponent), MOST_ALPHA);
            if alpha < SEEN { continue; }
            let then = live * (1.0 - alpha);
            if then >= LEAST_TRANSMITTANCE {
                sum += live * alpha * near[3u * k + 2u];
                live = then;
                left = then;
            } else {
                live = 0.0;
            }
        }
        chunk++;
        if live > 0.0 { atomicStore(&lastOpen, chunk); }
        workgroupBarrier();
        if lane == 0u { isOpen = select(0u, 1u, atomicLoad(&lastOpen) == chunk); }
        if workgroupUniformLoad(&isOpen) == 0u { break; }
    }
    if !shown { return; }
    let pixels = view.width * view.height;
    let colour = min(sum.rgb + left * view.background.rgb, vec3f(1.0));
    let alpha = 1.0 - left;
    out[3u * number] = colour.r;
    out[3u * number + 1u] = colour.g;
    out[3u * number + 2u] = colour.b;
    out[3u * pixels + number] = alpha;
    var far = 0.0;
    if alpha > 0.0 {
        let at = (place + vec2f(corner) - view.optics.zw) / view.optics.xy;
        let square = dot(vec3f(at * at, 1.0), view.squares.xyz)
            + 2.0 * dot(vec3f(at.x * at.y, at.x, at.y), view.products.xyz);
        far = sum.a / alpha * sqrt(square);
    }
    out[4u * pixels + number] = far;
}
