// The tables in which a cell is found by its place. WGSL. Paste view.wgsl above this file.
//
//   top    int32 of each place in the grids of bricks, x-major, shell after shell: the number of a brick, or minus the
//          distance to the nearest one
//   slots  an int16 for each of the 512 places of a brick, two in a word: cell << 1 | wide; -2 for one empty place, -1
//          in an empty block of 2^3
@group(1) @binding(13) var<storage, read> top: array<i32>;
@group(1) @binding(14) var<storage, read> slots: array<u32>;

fn brickAt(shell: i32, at: vec3i) -> i32 {
    let edge = i32(view.edge);
    return top[((shell * edge + at.x) * edge + at.y) * edge + at.z];
}

fn slotAt(brick: i32, cell: vec3i) -> i32 {
    let place = u32(((cell.x & 7) << 6u) | ((cell.y & 7) << 3u) | (cell.z & 7));
    let word = slots[256u * u32(brick) + (place >> 1u)];
    return bitcast<i32>(word << (16u * (1u - (place & 1u)))) >> 16u;
}
