using System;
using System.Reflection;
using Nerfbake;
using Nerfbake.Editor;
using NUnit.Framework;
using UnityEditor.AssetImporters;
using UnityEngine;

// Runs the package's own tests, the importer, and the meshes, on stubs of Unity's types: Check.exe IMPORTED...
static class CheckPackage
{
    static void Main(string[] paths)
    {
        foreach (MethodInfo method in typeof(ReaderTests).GetMethods())
            if (method.GetCustomAttributes(typeof(TestAttribute), false).Length > 0)
                Console.WriteLine("passed " + Run(method));
        foreach (string path in paths)
        {
            AssetImportContext context = new AssetImportContext { assetPath = path };
            new OctreeImporter().OnImportAsset(context);
            OctreeAsset asset = context.mainObject as OctreeAsset;
            Console.WriteLine(asset == null ? "refused " + string.Join("|", context.Errors) : "imported " + asset.Content);
            if (asset == null)
                continue;
            OctreeFile file = asset.Read();
            new OctreeBuffers(file).Dispose();
            Write("box", Hull.Box(file));
            Write("turned", Hull.FromObj(new Mesh { vertices = new[] { new Vector3(-1, 2, 3) }, triangles = new int[0] }));
            Console.WriteLine("rows " + string.Join(" ", Array.ConvertAll(Placement.ToVoxels(file), each => each.ToString("R"))));
        }
    }

    static string Run(MethodInfo method)
    {
        method.Invoke(new ReaderTests(), null);
        return method.Name;
    }

    static void Write(string name, Mesh mesh)
    {
        string vertices = string.Join(" ", Array.ConvertAll(mesh.vertices, v => v.x.ToString("R") + " " + v.y.ToString("R") + " " + v.z.ToString("R")));
        Console.WriteLine(name + " " + vertices + "|" + string.Join(" ", mesh.triangles));
    }
}
