// Write an entry for each tile that a splat reaches into. A thread for each splat. WGSL.
// Paste view.wgsl and tiles.wgsl above this file.
//
//   rows     as in project.wgsl
//   firsts   uint32 for each row: its first entry; one more: the number of entries
//   entries  a tile, counted from the first one that is made, and a row
@group(1) @binding(1) var<storage, read> rows: array<vec4f>;
@group(1) @binding(2) var<storage, read> firsts: array<u32>;
@group(1) @binding(3) var<storage, read_write> entries: array<vec2u>;

fn write(at: u32, tile: u32, number: u32) {
    entries[at] = vec2u(tile - view.begin * view.columns, number);
}

@compute @workgroup_size(64)
fn spread(@builtin(global_invocation_id) id: vec3u, @builtin(num_workgroups) groups: vec3u) {
    let i = threadOf(id, groups);
    if i >= view.count { return; }
    let first = firsts[i];
    let end = min(firsts[i + 1u], view.room);
    if first >= end { return; }
    let row = Row(rows[4u * i], rows[4u * i + 1u], rows[4u * i + 2u], rows[4u * i + 3u]);
    let written = first + visit(row, i, first, end);
    // A compiler may round the two visits differently: what is left belongs to no tile.
    for (var at = written; at < end; at++) { write(at, view.end * view.columns, i); }
}
