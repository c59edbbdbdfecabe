using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Reflection;
using Nerfbake;

// Answers a line on stdin with a line on stdout: what the package's reader finds in a file, or the one line that it throws.
// Words are separated by tabs; arrays go through files of little-endian numbers.
static class Check
{
    static void Main()
    {
        for (string line = Console.In.ReadLine(); line != null; line = Console.In.ReadLine())
        {
            string answer;
            try
            {
                answer = "ok\t" + Answer(line.Split('\t'));
            }
            catch (OctreeException error)
            {
                answer = "refused\t" + error.Message;
            }
            catch (Exception error)
            {
                answer = "crashed\t" + error.GetType().Name + " " + error.Message;
            }
            Console.Out.WriteLine(answer);
            Console.Out.Flush();
        }
    }

    static string Answer(string[] words)
    {
        OctreeFile file = OctreeFile.Read(File.ReadAllBytes(words[1]));
        switch (words[0])
        {
            case "read": return Read(file, words[2]);
            case "look up": return LookUp(file.ToNumbers(), Floats(words[2]), words[3]);
            case "colours": return Colours(file.ToNumbers(), Floats(words[2]), words[3]);
            case "names": return Names(file);
            case "as SH9Voxel": return file.ToVoxels<SH9Voxel>().NodeData.Length.ToString();
            default: throw new ArgumentException(words[0]);
        }
    }

    static string Read(OctreeFile file, string target)
    {
        float[] values = file.ToNumbers().NodeData;
        byte[] bytes = new byte[4 * (file.NodeChildren.Length + values.Length)];
        Buffer.BlockCopy(file.NodeChildren, 0, bytes, 0, 4 * file.NodeChildren.Length);
        Buffer.BlockCopy(values, 0, bytes, 4 * file.NodeChildren.Length, 4 * values.Length);
        File.WriteAllBytes(target, bytes);
        List<string> facts = new List<string> { file.DataFormat, file.HasHalves ? "float16" : "float32" };
        foreach (object number in new object[] { file.Width, file.Height, file.Depth, file.Count, file.DataDim })
            facts.Add(number.ToString());
        facts.Add(string.Join(" ", file.LevelSizes));
        foreach (double[] place in new[] { file.Origin, file.VoxelSize })
            foreach (double number in place)
                facts.Add(number.ToString("R", CultureInfo.InvariantCulture));
        return string.Join("\t", facts);
    }

    // Of each point in voxels what is nearest, then all of what is between, D floats each.
    static string LookUp(SparseVoxelOctree<float> octree, float[] points, string target)
    {
        int count = points.Length / 3, d = octree.DataDim;
        float[] found = new float[2 * count * d], values = new float[d];
        for (int i = 0; i < count; i++)
        {
            octree.Nearest(points[3 * i], points[3 * i + 1], points[3 * i + 2], values);
            Array.Copy(values, 0, found, i * d, d);
            octree.Trilinear(points[3 * i], points[3 * i + 1], points[3 * i + 2], values);
            Array.Copy(values, 0, found, (count + i) * d, d);
        }
        Write(found, target);
        return count.ToString();
    }

    // Of each point and each direction beside it the colour that is nearest.
    static string Colours(SparseVoxelOctree<float> octree, float[] asked, string target)
    {
        float[] found = new float[asked.Length / 2], values = new float[octree.DataDim], colour = new float[3];
        for (int i = 0; i < asked.Length; i += 6)
        {
            octree.Nearest(asked[i], asked[i + 1], asked[i + 2], values);
            SphericalHarmonics.Colour(octree.DataFormat, values, asked[i + 3], asked[i + 4], asked[i + 5], colour);
            Array.Copy(colour, 0, found, i / 2, 3);
        }
        Write(found, target);
        return found.Length.ToString();
    }

    // The names and the values of the last node's struct; they must be those that the lookup of structs gives, too.
    static string Names(OctreeFile file)
    {
        switch (file.DataFormat)
        {
            case "RGBA": return NamesIn(file.ToVoxels<RGBAVoxel>());
            case "SH1": return NamesIn(file.ToVoxels<SH1Voxel>());
            case "SH4": return NamesIn(file.ToVoxels<SH4Voxel>());
            case "SH9": return NamesIn(file.ToVoxels<SH9Voxel>());
            case "SH16": return NamesIn(file.ToVoxels<SH16Voxel>());
            default: return NamesIn(file.ToVoxels<SH25Voxel>());
        }
    }

    static string NamesIn<T>(SparseVoxelOctree<T> octree) where T : struct
    {
        float[] floats = new float[octree.DataDim];
        int steps = 0;
        for (float x = 0.5f; x < octree.Width; x++)
            for (float y = 0.5f; y < octree.Height; y++)
                for (float z = 0.5f; z < octree.Depth; z++, steps++)
                {
                    octree.Nearest(x, y, z, floats);
                    if (string.Join(" ", floats) != string.Join(" ", Values("", octree.Nearest(x, y, z), false)))
                        throw new Exception("a struct holds other floats than its node");
                }
        return steps + "\t" + string.Join("\t", Values("", octree.NodeData[octree.Count - 1], true));
    }

    static List<string> Values(string name, object value, bool named)
    {
        List<string> found = new List<string>();
        if (value is float)
            found.Add((named ? name + "=" : "") + (named ? ((float)value).ToString("R", CultureInfo.InvariantCulture) : value.ToString()));
        else
            foreach (FieldInfo field in value.GetType().GetFields())
                found.AddRange(Values(name + (name == "" ? "" : ".") + field.Name, field.GetValue(value), named));
        return found;
    }

    static float[] Floats(string path)
    {
        byte[] bytes = File.ReadAllBytes(path);
        float[] floats = new float[bytes.Length / 4];
        Buffer.BlockCopy(bytes, 0, floats, 0, bytes.Length);
        return floats;
    }

    static void Write(float[] values, string path)
    {
        byte[] bytes = new byte[4 * values.Length];
        Buffer.BlockCopy(values, 0, bytes, 0, bytes.Length);
        File.WriteAllBytes(path, bytes);
    }
}
