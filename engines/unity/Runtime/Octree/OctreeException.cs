using System;

namespace Nerfbake
{
    /// <summary>What is wrong with a file, in one line: the place, what was found there, and what is allowed.</summary>
    public sealed class OctreeException : Exception
    {
        public OctreeException(string place, string found, string allowed)
            : base(place + " " + found + "; allowed: " + allowed)
        {
        }
    }
}
