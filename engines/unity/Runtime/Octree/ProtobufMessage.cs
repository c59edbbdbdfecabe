using System;
using System.Collections.Generic;
using System.Text;

namespace Nerfbake
{
    /// <summary>
    /// The fields of a Protocol Buffers message by their numbers. Supports numbers, text, bytes and packed arrays; the
    /// payloads are not copied. Unknown fields are skipped. For any input, each byte is read once, and nothing larger
    /// than the file is allocated.
    /// </summary>
    internal sealed class ProtobufMessage
    {
        private const int MaxFields = 10000;
        private const int Varint = 0, Fixed64 = 1, Bytes = 2, Fixed32 = 5;

        private struct Field
        {
            public int Wire, Start, Length;
            public ulong Value;
        }

        private readonly byte[] data;
        private readonly Dictionary<ulong, List<Field>> fields = new Dictionary<ulong, List<Field>>();

        public ProtobufMessage(byte[] data)
        {
            this.data = data;
            int count = 0;
            for (int at = 0; at < data.Length;)
            {
                int start = at;
                ulong tag = ReadVarint(ref at, data.Length);
                Field field = new Field { Wire = (int)(tag & 7) };
                if (tag >> 3 == 0 || tag >> 3 >= 1UL << 29)
                    throw new OctreeException("byte " + start, "starts field " + (tag >> 3), "fields from 1");
                ReadPayload(ref field, ref at, start);
                if (++count > MaxFields)
                    throw new OctreeException("message", "has more than 10000 fields", "arrays packed, as listing 3 has them");
                List<Field> same;
                if (!fields.TryGetValue(tag >> 3, out same))
                    fields[tag >> 3] = same = new List<Field>();
                same.Add(field);
            }
        }

        private void ReadPayload(ref Field field, ref int at, int start)
        {
            ulong length;
            switch (field.Wire)
            {
                case Varint: field.Value = ReadVarint(ref at, data.Length); return;
                case Fixed64: length = 8; break;
                case Fixed32: length = 4; break;
                case Bytes: length = ReadVarint(ref at, data.Length); break;
                default: throw new OctreeException("byte " + start, "has wire type " + field.Wire, "0, 1, 2 or 5");
            }
            if (length > (ulong)(data.Length - at))
                throw new OctreeException("byte " + start, "starts a field of " + length + " bytes", "fields that end by " + data.Length);
            field.Start = at;
            field.Length = (int)length;
            at += field.Length;
        }

        private ulong ReadVarint(ref int at, int end)
        {
            ulong value = 0;
            int start = at;
            for (int shift = 0; shift < 70 && at < end; shift += 7)
            {
                byte part = data[at++];
                value |= (ulong)(part & 0x7F) << shift;
                if (part < 0x80)
                    return value;
            }
            throw new OctreeException("byte " + start, "starts a varint that does not end", "10 bytes, inside the file");
        }

        private List<Field> Of(int number, int wire)
        {
            List<Field> found;
            if (!fields.TryGetValue((ulong)number, out found))
                return new List<Field>();
            foreach (Field field in found)
                if (field.Wire != wire)
                    throw new OctreeException("field " + number, "has wire type " + field.Wire, wire + ", as svo.proto declares it");
            return found;
        }

        /// <summary>An integer of 32 bits; 0 if absent. If the field is repeated, the last one counts.</summary>
        public int Number(int number)
        {
            List<Field> found = Of(number, Varint);
            return found.Count == 0 ? 0 : unchecked((int)(uint)found[found.Count - 1].Value);
        }

        /// <summary>A bytes field; empty if absent. If the field is repeated, the last one counts.</summary>
        public ArraySegment<byte> Last(int number)
        {
            List<Field> found = Of(number, Bytes);
            if (found.Count == 0)
                return new ArraySegment<byte>(data, 0, 0);
            Field last = found[found.Count - 1];
            return new ArraySegment<byte>(data, last.Start, last.Length);
        }

        public string Text(int number)
        {
            ArraySegment<byte> last = Last(number);
            try
            {
                return new UTF8Encoding(false, true).GetString(last.Array, last.Offset, last.Count);
            }
            catch (ArgumentException)
            {
                throw new OctreeException("field " + number, "is no UTF-8", "text");
            }
        }

        /// <summary>The lower 32 bits of a packed array of varints, which may be split into several runs.</summary>
        public int[] WholeNumbers(int number)
        {
            List<Field> runs = Of(number, Bytes);
            int count = 0;
            foreach (Field run in runs)
                for (int at = run.Start; at < run.Start + run.Length; at++)
                    count += data[at] < 0x80 ? 1 : 0;
            int[] numbers = new int[count];
            int next = 0;
            foreach (Field run in runs)
                for (int at = run.Start; at < run.Start + run.Length;)
                    numbers[next++] = unchecked((int)(uint)ReadVarint(ref at, run.Start + run.Length));
            return numbers;
        }

        /// <summary>A packed array of doubles, which may be split into several runs.</summary>
        public double[] Doubles(int number, string name)
        {
            List<double> found = new List<double>();
            foreach (Field run in Of(number, Bytes))
            {
                if (run.Length % 8 != 0)
                    throw new OctreeException(name, "has " + run.Length + " bytes", "a multiple of 8");
                for (int at = run.Start; at < run.Start + run.Length; at += 8)
                    found.Add(BitConverter.ToDouble(data, at));
            }
            return found.ToArray();
        }
    }
}
