// The search for close pairs of elements, and the maps between vertices and the corners of pairs, for CPUs.
//
// pair_kernels.py documents them, builds this file after threads.h and calls it through XLA's foreign function interface
// (FFI). The search descends the trees of broad_phase.py depth first, which gives the pairs in the same order.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>
#include <vector>

namespace {

constexpr int64_t kArity = 4;

template <typename T>
struct Vec {
  T x[3];
  Vec operator-(const Vec& o) const { return {{x[0] - o.x[0], x[1] - o.x[1], x[2] - o.x[2]}}; }
  Vec operator+(const Vec& o) const { return {{x[0] + o.x[0], x[1] + o.x[1], x[2] + o.x[2]}}; }
  Vec operator*(T s) const { return {{s * x[0], s * x[1], s * x[2]}}; }
  T Dot(const Vec& o) const { return x[0] * o.x[0] + x[1] * o.x[1] + x[2] * o.x[2]; }
};

template <typename T>
T Unit(T t) {
  return t > T(0) ? (t < T(1) ? t : T(1)) : T(0);  // NaN (0 / 0 on an edge of no length) becomes 0
}

template <typename T>
T SquareToSegment(const Vec<T>& p, const Vec<T>& a, const Vec<T>& b) {
  const Vec<T> edge = b - a;
  const Vec<T> away = p - (a + edge * Unit((p - a).Dot(edge) / edge.Dot(edge)));
  return away.Dot(away);
}

template <typename T>
T SquareToTriangle(const Vec<T>& p, const Vec<T>& a, const Vec<T>& b, const Vec<T>& c) {
  const Vec<T> first = b - a, second = c - a, toward = p - a;
  const T f = first.Dot(first), g = first.Dot(second), h = second.Dot(second);
  const T d = first.Dot(toward), e = second.Dot(toward);
  const T det = std::max(f * h - g * g, T(1e-12) * f * h);
  const T u = (h * d - g * e) / det, v = (f * e - g * d) / det;
  if (u >= 0 && v >= 0 && u + v <= 1) {
    const Vec<T> away = toward - first * u - second * v;
    return away.Dot(away);
  }
  return std::min({SquareToSegment(p, a, b), SquareToSegment(p, b, c), SquareToSegment(p, c, a)});
}

// As closest.segments with a small smoothing.
template <typename T>
T SquareOfSegments(const Vec<T>& a0, const Vec<T>& a1, const Vec<T>& b0, const Vec<T>& b1) {
  const Vec<T> first = a1 - a0, second = b1 - b0, between = b0 - a0;
  const T extra = T(2e-6) * first.Dot(first);
  const T a = first.Dot(first) + 2 * extra, b = first.Dot(second), c = second.Dot(second) + 2 * extra;
  const T p = first.Dot(between) + extra, q = extra - second.Dot(between);
  T s = Unit((c * p + b * q) / (a * c - b * b));
  const T t = Unit((q + b * s) / c);
  s = Unit((p + b * t) / a);
  const Vec<T> away = first * s - second * t - between;
  return away.Dot(away);
}

// Elements of one kind: vertices, edges or triangles.
template <typename T>
struct Kind {
  const int32_t* corners;  // [corner][element]
  const int32_t* rope;     // whether an element is of a rope
  const int32_t* order;    // along the tree, -1 for none
  int64_t num_corners, count, places;

  Vec<T> At(const T* x, int64_t vertices, int64_t element, int64_t corner) const {
    const int64_t v = corners[corner * count + element];
    return {{x[v], x[vertices + v], x[2 * vertices + v]}};
  }
};

// Boxes of one level of a tree, [axis][box]. Their number is rounded up to a multiple of kArity by empty boxes.
template <typename T>
struct Boxes {
  std::vector<T> lower[3], upper[3];

  explicit Boxes(int64_t count) {
    const size_t full = static_cast<size_t>((count + kArity - 1) / kArity * kArity);
    for (auto& side : lower) side.assign(full, std::numeric_limits<T>::infinity());
    for (auto& side : upper) side.assign(full, -std::numeric_limits<T>::infinity());
  }
  int64_t count() const { return static_cast<int64_t>(lower[0].size()); }
};

// Numbers of kArity neighbouring boxes.
typedef float FourFloats __attribute__((vector_size(kArity * sizeof(float))));
typedef double FourDoubles __attribute__((vector_size(kArity * sizeof(double))));
template <typename T>
using Four = std::conditional_t<std::is_same_v<T, float>, FourFloats, FourDoubles>;
template <typename T>
using Mask = decltype(Four<T>{} < Four<T>{});

template <typename T>
Four<T> LoadFour(const T* from) {
  Four<T> r;
  std::memcpy(&r, from, sizeof(r));
  return r;
}

template <typename T>
using Levels = std::vector<Boxes<T>>;

template <typename T>
struct Search {
  const T* x;  // [axis][vertex]
  T half[2], skin;
  int64_t vertices, levels, capacity, num_near;
  bool same;
  Kind<T> a, b;
  const int32_t* near;  // [element][entry], neighbours that do not touch
  Levels<T> of_a, of_b;
  int32_t *first, *second;
  int64_t found = 0;

  Levels<T> BoxesOf(const Kind<T>& kind) const {
    Levels<T> boxes;
    boxes.emplace_back(kind.places);
    for (int64_t i = 0; i < kind.places; ++i) {
      const int64_t element = kind.order[i];
      if (element < 0) continue;
      const T reach = half[kind.rope[element]] + T(0.5) * skin;
      for (int64_t c = 0; c < kind.num_corners; ++c) {
        const Vec<T> at = kind.At(x, vertices, element, c);
        for (int k = 0; k < 3; ++k) {
          boxes[0].lower[k][i] = std::min(boxes[0].lower[k][i], at.x[k] - reach);
          boxes[0].upper[k][i] = std::max(boxes[0].upper[k][i], at.x[k] + reach);
        }
      }
    }
    for (int64_t level = 1; level <= levels; ++level) {
      const int64_t count = kind.places >> (2 * level);
      boxes.emplace_back(count);
      const Boxes<T>& inner = boxes[level - 1];
      for (int k = 0; k < 3; ++k) {
        for (int64_t i = 0; i < count; ++i) {
          const T* const lower = &inner.lower[k][kArity * i];
          const T* const upper = &inner.upper[k][kArity * i];
          boxes[level].lower[k][i] = std::min(std::min(lower[0], lower[1]), std::min(lower[2], lower[3]));
          boxes[level].upper[k][i] = std::max(std::max(upper[0], upper[1]), std::max(upper[2], upper[3]));
        }
      }
    }
    return boxes;
  }

  void Run() {
    of_a = BoxesOf(a);
    if (!same) of_b = BoxesOf(b);
    const int64_t num_a = a.places >> (2 * levels), num_b = (same ? of_a : of_b)[levels].count();
    for (int64_t i = 0; i < num_a; ++i) {
      for (int64_t j = same ? i / kArity * kArity : 0; j < num_b; j += kArity) Meet(levels, i, j);
    }
  }

  // A box of one tree and kArity neighbouring boxes of the other.
  void Meet(int64_t level, int64_t i, int64_t j) {
    const Boxes<T>&p = of_a[level], &q = (same ? of_a : of_b)[level];
    Mask<T> overlap = Mask<T>{} == 0;
    for (int k = 0; k < 3; ++k) {
      const Four<T> zero{};
      overlap &= (zero + p.lower[k][i] <= LoadFour(&q.upper[k][j])) & (LoadFour(&q.lower[k][j]) <= zero + p.upper[k][i]);
    }
    if (!(overlap[0] | overlap[1] | overlap[2] | overlap[3])) return;
    for (int64_t n = 0; n < kArity; ++n) {
      // Beyond the last box, and in empty places, boxes are (inf, -inf), which overlaps a box without bounds.
      if (!overlap[n] || j + n >= (same ? a : b).places >> (2 * level)) continue;
      if (same && (level ? i > j + n : i >= j + n)) continue;
      if (level == 0) {
        const int32_t one = a.order[i], other = (same ? a : b).order[j + n];
        if (one >= 0 && other >= 0) Meet(one, other);
        continue;
      }
      for (int64_t m = 0; m < kArity; ++m) Meet(level - 1, kArity * i + m, kArity * (j + n));
    }
  }

  void Meet(int64_t i, int64_t j) {
    const int32_t* entries = near + i * num_near;
    bool neighbours = false;
    for (int64_t k = 0; k < num_near; ++k) neighbours |= entries[k] == j;
    if (neighbours) return;
    const Kind<T>& other = same ? a : b;
    const T reach = half[a.rope[i]] + half[other.rope[j]] + skin;
    const auto p = [&](int64_t c) { return a.At(x, vertices, i, c); };
    const auto q = [&](int64_t c) { return other.At(x, vertices, j, c); };
    const T square = same ? SquareOfSegments(p(0), p(1), q(0), q(1)) : SquareToTriangle(p(0), q(0), q(1), q(2));
    if (!(square < reach * reach)) return;
    if (found < capacity) {
      first[found] = static_cast<int32_t>(i);
      second[found] = static_cast<int32_t>(j);
    }
    ++found;
  }
};

template <typename T>
void FindPairs(ffi::ThreadPool& pool, ffi::RemainingArgs& args, ffi::RemainingRets& rets, const int64_t* sizes) {
  const auto ints = [&](int k) { return static_cast<const int32_t*>(args.get<ffi::AnyBuffer>(k)->untyped_data()); };
  const auto reals = [&](int k) { return static_cast<const T*>(args.get<ffi::AnyBuffer>(k)->untyped_data()); };
  const auto out = [&](int k) { return static_cast<int32_t*>((*rets.get<ffi::AnyBuffer>(k))->untyped_data()); };
  const int64_t batch = sizes[0], capacity = sizes[3], vertices = sizes[4];
  const Kind<T> a{ints(2), ints(3), ints(4), sizes[5], sizes[6], sizes[7]};
  const Kind<T> b{ints(6), ints(7), ints(8), sizes[8], sizes[9], sizes[10]};
  const T *x = reals(0), *lengths = reals(1);
  const int32_t* near = ints(5);
  int32_t *first = out(0), *second = out(1), *found = out(2);
  ForEach(pool, batch, [&](int64_t e) {
    const T* own = lengths + 3 * e;
    Search<T> search{x + 3 * vertices * e, {own[0], own[1]}, own[2], vertices, sizes[2], capacity, sizes[11],
                     sizes[1] != 0, a, b, near, {}, {}, first + capacity * e, second + capacity * e};
    std::fill_n(search.first, capacity, 0);
    std::fill_n(search.second, capacity, 0);
    search.Run();
    found[e] = static_cast<int32_t>(std::min<int64_t>(search.found, std::numeric_limits<int32_t>::max()));
  });
}

// out[4 f + corner][pair] = field[f][vertex of the corner]
template <typename T>
void ToCorners(ffi::ThreadPool& pool, ffi::RemainingArgs& args, ffi::RemainingRets& rets, const int64_t* sizes) {
  const int64_t batch = sizes[0], fields = sizes[1], vertices = sizes[2], pairs = sizes[3];
  const auto* corners = static_cast<const int32_t*>(args.get<ffi::AnyBuffer>(0)->untyped_data());
  std::vector<const T*> in(fields);
  std::vector<T*> out(4 * fields);
  for (int64_t f = 0; f < fields; ++f) in[f] = static_cast<const T*>(args.get<ffi::AnyBuffer>(1 + f)->untyped_data());
  for (int64_t k = 0; k < 4 * fields; ++k) out[k] = static_cast<T*>((*rets.get<ffi::AnyBuffer>(k))->untyped_data());
  ForEach(pool, batch, [&](int64_t e) {
    for (int64_t corner = 0; corner < 4; ++corner) {
      const int32_t* at = corners + (4 * e + corner) * pairs;
      for (int64_t f = 0; f < fields; ++f) {
        const T* from = in[f] + e * vertices;
        T* to = out[4 * f + corner] + e * pairs;
        for (int64_t p = 0; p < pairs; ++p) to[p] = from[at[p]];
      }
    }
  });
}

// field[f][vertex] = sum of in[4 f + corner][pair] over the corners at the vertex
template <typename T>
void ToVertices(ffi::ThreadPool& pool, ffi::RemainingArgs& args, ffi::RemainingRets& rets, const int64_t* sizes) {
  const int64_t batch = sizes[0], fields = sizes[1], vertices = sizes[2], pairs = sizes[3];
  const auto* corners = static_cast<const int32_t*>(args.get<ffi::AnyBuffer>(0)->untyped_data());
  std::vector<const T*> in(4 * fields);
  std::vector<T*> out(fields);
  for (int64_t k = 0; k < 4 * fields; ++k) in[k] = static_cast<const T*>(args.get<ffi::AnyBuffer>(1 + k)->untyped_data());
  for (int64_t f = 0; f < fields; ++f) out[f] = static_cast<T*>((*rets.get<ffi::AnyBuffer>(f))->untyped_data());
  ForEach(pool, batch, [&](int64_t e) {
    for (int64_t f = 0; f < fields; ++f) {
      T* to = out[f] + e * vertices;
      std::fill_n(to, vertices, T(0));
      for (int64_t corner = 0; corner < 4; ++corner) {
        const int32_t* at = corners + (4 * e + corner) * pairs;
        const T* from = in[4 * f + corner] + e * pairs;
        for (int64_t p = 0; p < pairs; ++p) to[at[p]] += from[p];
      }
    }
  });
}

#define REWAX_KERNEL(name, typed)                                                                                  \
  ffi::Error Run##name(ffi::ThreadPool pool, ffi::RemainingArgs args, ffi::RemainingRets rets,                     \
                       ffi::Span<const int64_t> sizes) {                                                           \
    if (args.get<ffi::AnyBuffer>(typed)->element_type() == ffi::DataType::F64) {                                   \
      name<double>(pool, args, rets, sizes.begin());                                                               \
    } else {                                                                                                       \
      name<float>(pool, args, rets, sizes.begin());                                                                \
    }                                                                                                              \
    return ffi::Error::Success();                                                                                  \
  }

REWAX_KERNEL(FindPairs, 0)
REWAX_KERNEL(ToCorners, 1)
REWAX_KERNEL(ToVertices, 1)

}  // namespace

#define REWAX_EXPORT(symbol, name)                                                                                 \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(symbol, Run##name,                                                                 \
                                ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets()            \
                                    .Attr<ffi::Span<const int64_t>>("sizes"))

REWAX_EXPORT(rewax_find_pairs, FindPairs);
REWAX_EXPORT(rewax_pairs_to_corners, ToCorners);
REWAX_EXPORT(rewax_pairs_to_vertices, ToVertices);
