// Moves values between vertices and the corners of elements, four fields of a vertex at a time: one load or store of
// four neighbouring numbers costs as much as one of a single number.

#include <vector>

namespace {

typedef T Quad __attribute__((vector_size(4 * sizeof(T)), aligned(sizeof(T)), may_alias));
typedef decltype(Quad{} < Quad{}) QuadIndex;

#if defined(__clang__)
#define REWAX_SHUFFLE(a, b, i, j, k, l) __builtin_shufflevector(a, b, i, j, k, l)
#else
#define REWAX_SHUFFLE(a, b, i, j, k, l) __builtin_shuffle(a, b, QuadIndex{i, j, k, l})
#endif

inline Quad Load(const T* from) { return *reinterpret_cast<const Quad*>(from); }
inline void Store(T* to, Quad a) { *reinterpret_cast<Quad*>(to) = a; }

inline void Transpose(Quad& a, Quad& b, Quad& c, Quad& d) {
  const Quad ab = REWAX_SHUFFLE(a, b, 0, 4, 1, 5), cd = REWAX_SHUFFLE(c, d, 0, 4, 1, 5);
  const Quad ab2 = REWAX_SHUFFLE(a, b, 2, 6, 3, 7), cd2 = REWAX_SHUFFLE(c, d, 2, 6, 3, 7);
  a = REWAX_SHUFFLE(ab, cd, 0, 1, 4, 5);
  b = REWAX_SHUFFLE(ab, cd, 2, 3, 6, 7);
  c = REWAX_SHUFFLE(ab2, cd2, 0, 1, 4, 5);
  d = REWAX_SHUFFLE(ab2, cd2, 2, 3, 6, 7);
}

// Four rows as records of `stride` numbers, and back.
inline void Pack(const T* const* rows, T* records, int64_t stride, int64_t count) {
  for (int64_t k = 0; k + 4 <= count; k += 4, records += 4 * stride) {
    Quad a = Load(rows[0] + k), b = Load(rows[1] + k), c = Load(rows[2] + k), d = Load(rows[3] + k);
    Transpose(a, b, c, d);
    Store(records, a);
    Store(records + stride, b);
    Store(records + 2 * stride, c);
    Store(records + 3 * stride, d);
  }
  for (int64_t k = count / 4 * 4; k < count; ++k, records += stride) {
    for (int f = 0; f < 4; ++f) records[f] = rows[f][k];
  }
}

// How the elements of a batch element read fields over vertices and write results at corners.
struct Corners {
  const int64_t* reads;    // for each argument: (corner, field), as one number; -1: it is no array over vertices
  const int64_t* outputs;  // for each output: index of the result, or -1 minus (corner, field), as one number
  const int32_t* index;    // [corner][element]: vertices of the elements
  int64_t count, num_corners;
  const T* vertices;  // [vertex][read_stride]: fields
  T* records;         // [corner][element][written_stride]: results
  int64_t read_quads, written_quads, read_stride, written_stride, plane_length;

  // Fills rows [corner][field] of a block with the values of fields at corners; null rows are not wanted.
  void Gather(T* const* rows, T* unwanted, int64_t begin, int64_t size, int64_t padded) const {
    for (int64_t corner = 0; corner < num_corners; ++corner) {
      const int32_t* const at = index + corner * count + begin;
      for (int64_t quad = 0; quad < read_quads; ++quad, rows += 4) {
        T* to[4];
        int wanted = 0;
        for (int f = 0; f < 4; ++f) {
          to[f] = rows[f] ? rows[f] : unwanted;
          wanted += rows[f] != nullptr;
        }
        const T* const from = vertices + 4 * quad;
        if (wanted < 2) {
          for (int f = 0; f < 4; ++f) One(from + f, at, rows[f], size, padded);
          continue;
        }
        int64_t k = 0;
        for (; k + 4 <= size; k += 4) Four(from, at + k, to, k);
        for (; k < padded; k += 4) {  // the last element is repeated
          int32_t last[4];
          for (int l = 0; l < 4; ++l) last[l] = at[std::min(k + l, size - 1)];
          Four(from, last, to, k);
        }
      }
    }
  }

  // Writes rows [corner][field] of a block to the records; null rows have no meaning.
  void Write(const T* const* rows, const T* meaningless, int64_t begin, int64_t size) const {
    for (int64_t corner = 0; corner < num_corners; ++corner) {
      T* const to = records + (corner * plane_length + begin) * written_stride;
      for (int64_t quad = 0; quad < written_quads; ++quad, rows += 4) {
        if (written_stride == 1) {
          std::copy(rows[0], rows[0] + size, to);
          continue;
        }
        const T* from[4];
        for (int f = 0; f < 4; ++f) from[f] = rows[f] ? rows[f] : meaningless;
        Pack(from, to + 4 * quad, written_stride, size);
      }
    }
  }

 private:
  void One(const T* from, const int32_t* at, T* to, int64_t size, int64_t padded) const {
    if (!to) return;
    for (int64_t k = 0; k < size; ++k) to[k] = from[at[k] * read_stride];
    std::fill(to + size, to + padded, to[size - 1]);
  }
  void Four(const T* from, const int32_t* at, T* const* to, int64_t k) const {
    Quad a = Load(from + at[0] * read_stride), b = Load(from + at[1] * read_stride);
    Quad c = Load(from + at[2] * read_stride), d = Load(from + at[3] * read_stride);
    Transpose(a, b, c, d);
    Store(to[0] + k, a);
    Store(to[1] + k, b);
    Store(to[2] + k, c);
    Store(to[3] + k, d);
  }
};

// Sums records of one number at each vertex, by lists of its entries.
inline void SumNumbers(const int32_t* starts, const int32_t* entries, const T* records, T* to, int64_t begin,
                       int64_t end) {
  for (int64_t vertex = begin; vertex < end; ++vertex) {
    T sum = 0;
    for (int32_t k = starts[vertex]; k < starts[vertex + 1]; ++k) sum += records[entries[k]];
    to[vertex] = sum;
  }
}

// The same for records of groups of four numbers.
template <int kQuads>
void SumListed(const int32_t* starts, const int32_t* entries, const T* records, int64_t stride, T* const* to,
               int64_t begin, int64_t end) {
  for (int64_t vertex = begin; vertex < end; ++vertex) {
    Quad sum[kQuads] = {};
    for (int32_t k = starts[vertex]; k < starts[vertex + 1]; ++k) {
      for (int q = 0; q < kQuads; ++q) sum[q] += Load(records + entries[k] * stride + 4 * q);
    }
    for (int f = 0; f < 4 * kQuads; ++f) {
      if (to[f]) to[f][vertex] = sum[f / 4][f % 4];
    }
  }
}

}  // namespace
