using Nerfbake;
using NUnit.Framework;

/// <summary>Tests of the reader in Unity's own runtime. Tests under Mono compare it with schemas/conformance.</summary>
public sealed class ReaderTests
{
    // 2 x 2 x 2 voxels, RGBA: the root, and one child at x = 1, y = 1, z = 0 with density 4.
    private static readonly byte[] File =
    {
        0x10, 2, 0x18, 2, 0x20, 2, 0x2A, 16, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
        0x32, 32, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
        0, 0, 128, 63, 0, 0, 0, 64, 0, 0, 64, 64, 0, 0, 128, 64,
    };

    [Test]
    public void AVoxelHasItsValues()
    {
        SparseVoxelOctree<RGBAVoxel> octree = OctreeFile.Read(File).ToVoxels<RGBAVoxel>();
        Assert.AreEqual(4f, octree.Nearest(1.5f, 1.5f, 0.5f).Sigma);
        Assert.AreEqual(0f, octree.Nearest(0.5f, 1.5f, 0.5f).Sigma);
    }

    [Test]
    public void AFileThatIsCutOffIsRefused()
    {
        byte[] cut = new byte[30];
        System.Array.Copy(File, cut, cut.Length);
        Assert.Throws<OctreeException>(() => OctreeFile.Read(cut));
    }

    [Test]
    public void AnAssetIsDrawnInItsBox()
    {
        OctreeAsset asset = OctreeAsset.From(File);
        Assert.AreEqual("RGBA octree of 2x2x2, 2 nodes", asset.Content);
        Assert.AreEqual(8, Hull.Box(asset.Read()).vertices.Length);
    }
}
