// The colours of all cells as the camera of a view sees them, and their densities. A workgroup for each brick. WGSL.
// Paste cells.wgsl above this file.
@compute @workgroup_size(64)
fn paint(
    @builtin(workgroup_id) group: vec3u, @builtin(num_workgroups) groups: vec3u, @builtin(local_invocation_index) lane: u32
) {
    let number = part.x + group.y * groups.x + group.x;
    if number >= part.y { return; }
    let brick = brickOf(number);
    for (var cell = lane; cell < brick.count; cell += 64u) {
        let place = placeOf(brick.first + cell);
        var basis = harmonics(lookAt(brick, place), B);
        var sum = vec3f(0.0);
        var at = brick.start + cell;
        for (var k = 0; k < B; k++) {
            let next = at + u32(B) * brick.count;
            sum += basis.f[k] * vec3f(values[at], values[next], values[next + u32(B) * brick.count]);
            at += brick.count;
        }
        let density = values[brick.start + 3u * u32(B) * brick.count + cell] * perWidth(brick, place);
        painted[brick.first + cell] = vec4f(sigmoid(clamp(sum, vec3f(-16.0), vec3f(16.0))), density);
    }
}
