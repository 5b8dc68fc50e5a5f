// The kernels of transfer.py for CPUs: one particle at a time, with its 27 nodes in registers.
//
// transfer_cpp.py documents each kernel, builds this file after threads.h and calls it through XLA's foreign function
// interface (FFI). A node is a vector of four numbers: a vector field along x, y, z, and the mass (or zero). Weights are
// computed for a block of particles at once. The order of summation on nodes is independent of batch size and thread
// count, so results are reproducible bit for bit.

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

namespace {

constexpr int kBlock = 16;               // particles whose weights are computed at once
constexpr int kFields = 16;              // numbers of a particle's affine field: value and three slopes, four each
constexpr int64_t kChunk = 1024;         // particles that a thread gathers for at a time
constexpr int64_t kPiece = 4096;         // particles that share one sum on the nodes
constexpr int64_t kMostPieces = 8;

template <typename T>
struct Vec;
template <>
struct Vec<float> {
  typedef float type __attribute__((vector_size(16)));
};
template <>
struct Vec<double> {
  typedef double type __attribute__((vector_size(32)));
};
template <typename T>
using V4 = typename Vec<T>::type;

struct Layout {
  int64_t shape[3];
  double origin[3];
  double spacing;
  int64_t nodes;      // of one environment
  bool listed;        // node arrays hold active nodes only, located by offsets of columns
  int64_t num_envs;
  int64_t particles;  // of one environment
  int64_t columns() const { return shape[0] * shape[1]; }
};

template <typename T>
struct Locations {
  const T* x[3];
  const int32_t* offset;
};

// --- Weights -------------------------------------------------------------------------------------------------------

template <typename T>
struct Axis {
  T w[3][kBlock];  // weights
  T s[3][kBlock];  // their slopes
  T d[3][kBlock];  // offsets of the nodes from the particle
};

template <typename T>
struct Stencils {
  Axis<T> axis[3];
  int32_t rows[9][kBlock];  // the lowest of three nodes along z in each of nine columns
};

// Not inlined: inlined copies may round differently, and all kernels must find the same lowest node.
template <typename T>
__attribute__((noinline)) void Weigh(const Layout& layout, const Locations<T>& locations, int64_t env, int64_t first,
                                     int count, Stencils<T>& st) {
  int32_t lowest[3][kBlock];
  const T spacing = T(layout.spacing), inverse = T(1.0 / layout.spacing);
  for (int a = 0; a < 3; ++a) {
    const T* source = locations.x[a] + env * layout.particles + first;
    const T origin = T(layout.origin[a]), highest = T(layout.shape[a] - 3);
    Axis<T>& axis = st.axis[a];
    T x[kBlock];
    for (int l = 0; l < kBlock; ++l) x[l] = source[l < count ? l : count - 1];
    for (int l = 0; l < kBlock; ++l) {
      const T cells = (x[l] - origin) * inverse;
      T low = cells - T(0.5);
      low = low > T(0) ? low : T(0);  // NaN becomes 0
      low = low < highest ? low : highest;
      const int32_t base = static_cast<int32_t>(low);
      lowest[a][l] = base;
      const T f = cells - T(base);
      axis.w[0][l] = T(0.5) * (T(1.5) - f) * (T(1.5) - f);
      axis.w[1][l] = T(0.75) - (f - T(1)) * (f - T(1));
      axis.w[2][l] = T(0.5) * (f - T(0.5)) * (f - T(0.5));
      axis.s[0][l] = -(T(1.5) - f) * inverse;
      axis.s[1][l] = T(-2) * (f - T(1)) * inverse;
      axis.s[2][l] = (f - T(0.5)) * inverse;
      axis.d[0][l] = -f * spacing;
      axis.d[1][l] = (T(1) - f) * spacing;
      axis.d[2][l] = (T(2) - f) * spacing;
    }
  }
  const int32_t ny = static_cast<int32_t>(layout.shape[1]), nz = static_cast<int32_t>(layout.shape[2]);
  const int32_t last = static_cast<int32_t>(layout.nodes) - 3;
  const int32_t* offset = layout.listed ? locations.offset + env * layout.columns() : nullptr;
  for (int c = 0; c < 9; ++c) {
    for (int l = 0; l < kBlock; ++l) {
      const int32_t column = (lowest[0][l] + c / 3) * ny + lowest[1][l] + c % 3;
      // A particle that left the active nodes uses other nodes; check_status sets INACTIVE_NODES.
      const int32_t row = (offset ? offset[column] : column * nz) + lowest[2][l];
      st.rows[c][l] = std::min(std::max(row, 0), last);
    }
  }
}

// --- Nodes as vectors ----------------------------------------------------------------------------------------------

template <typename T>
void Interleave(const T* const* fields, int count, int64_t first, int64_t nodes, V4<T>* out) {
  const T *x = fields[count - 3] + first, *y = fields[count - 2] + first, *z = fields[count - 1] + first;
  if (count == 4) {
    const T* mass = fields[0] + first;
    for (int64_t i = 0; i < nodes; ++i) out[i] = V4<T>{x[i], y[i], z[i], mass[i]};
  } else {
    for (int64_t i = 0; i < nodes; ++i) out[i] = V4<T>{x[i], y[i], z[i], T(0)};
  }
}

template <typename T>
void Separate(const V4<T>* nodes, int64_t count, int64_t first, int num_fields, T* const* fields) {
  T *x = fields[num_fields - 3] + first, *y = fields[num_fields - 2] + first, *z = fields[num_fields - 1] + first;
  T* mass = num_fields == 4 ? fields[0] + first : nullptr;
  for (int64_t i = 0; i < count; ++i) {
    x[i] = nodes[i][0];
    y[i] = nodes[i][1];
    z[i] = nodes[i][2];
  }
  if (mass) {
    for (int64_t i = 0; i < count; ++i) mass[i] = nodes[i][3];
  }
}

// Memory that a thread reuses from call to call.
template <typename T>
V4<T>* Room(std::vector<char>& bytes, int64_t count) {
  constexpr size_t alignment = 64;
  const size_t wanted = static_cast<size_t>(count) * sizeof(V4<T>) + alignment;
  if (bytes.size() < wanted) bytes.resize(wanted);
  const auto address = reinterpret_cast<uintptr_t>(bytes.data());
  return reinterpret_cast<V4<T>*>((address + alignment - 1) / alignment * alignment);
}

thread_local std::vector<char> room_of_call, room_of_task;

// --- One particle --------------------------------------------------------------------------------------------------

template <typename T>
struct Affine {
  V4<T> value, slope[3];
};

// Columns of the particles' affine field, in the order value, slope along x, y, z of the vector field, then the mass.
template <typename T>
struct FieldColumns {
  const T* value[3];
  const T* slope[3][3];  // [component][axis]
  const T* mass;         // or nullptr

  Affine<T> At(int64_t i) const {
    Affine<T> field;
    field.value = V4<T>{value[0][i], value[1][i], value[2][i], mass ? mass[i] : T(0)};
    for (int a = 0; a < 3; ++a) field.slope[a] = V4<T>{slope[0][a][i], slope[1][a][i], slope[2][a][i], T(0)};
    return field;
  }
};

template <typename T>
inline void ScatterOne(const Stencils<T>& st, int l, const Affine<T>& field, V4<T>* nodes) {
  const Axis<T>&X = st.axis[0], &Y = st.axis[1], &Z = st.axis[2];
  T lever[3];
  for (int k = 0; k < 3; ++k) lever[k] = Z.w[k][l] * Z.d[k][l];
  for (int i = 0; i < 3; ++i) {
    const V4<T> along_x = field.value + field.slope[0] * X.d[i][l];
    for (int j = 0; j < 3; ++j) {
      const T across = X.w[i][l] * Y.w[j][l];
      const V4<T> plane = (along_x + field.slope[1] * Y.d[j][l]) * across, tilt = field.slope[2] * across;
      V4<T>* node = nodes + st.rows[3 * i + j][l];
      for (int k = 0; k < 3; ++k) node[k] += plane * Z.w[k][l] + tilt * lever[k];
    }
  }
}

// Sums over the nodes of w g, and of w g times the offset along x, y, z.
template <typename T>
struct Moments {
  V4<T> value, first[3];
};

template <typename T>
inline Moments<T> GatherOne(const Stencils<T>& st, int l, const V4<T>* nodes) {
  const Axis<T>&X = st.axis[0], &Y = st.axis[1], &Z = st.axis[2];
  Moments<T> m = {};
  T lever[3];
  for (int k = 0; k < 3; ++k) lever[k] = Z.w[k][l] * Z.d[k][l];
  for (int i = 0; i < 3; ++i) {
    V4<T> ww = {}, ow = {}, wo = {};
    for (int j = 0; j < 3; ++j) {
      const V4<T>* g = nodes + st.rows[3 * i + j][l];
      const V4<T> w = g[0] * Z.w[0][l] + g[1] * Z.w[1][l] + g[2] * Z.w[2][l];
      const V4<T> o = g[0] * lever[0] + g[1] * lever[1] + g[2] * lever[2];
      const V4<T> weighted = w * Y.w[j][l];
      ww += weighted;
      ow += weighted * Y.d[j][l];
      wo += o * Y.w[j][l];
    }
    const V4<T> weighted = ww * X.w[i][l];
    m.value += weighted;
    m.first[0] += weighted * X.d[i][l];
    m.first[1] += ow * X.w[i][l];
    m.first[2] += wo * X.w[i][l];
  }
  return m;
}

// Derivative of sum over nodes of w g . (value + slope . offset) by the particle's position. The offsets contribute
// -slope^T (sum w g); the argument `value` is sum w g.
template <typename T>
inline void WorkOne(const Stencils<T>& st, int l, const Affine<T>& field, const V4<T>* nodes, const V4<T>& value,
                    T work[3]) {
  const Axis<T>&X = st.axis[0], &Y = st.axis[1], &Z = st.axis[2];
  V4<T> sum[3] = {};
  for (int i = 0; i < 3; ++i) {
    const V4<T> along_x = field.value + field.slope[0] * X.d[i][l];
    V4<T> ww = {}, sw = {}, ws = {};
    for (int j = 0; j < 3; ++j) {
      const V4<T>* g = nodes + st.rows[3 * i + j][l];
      const V4<T> plane = along_x + field.slope[1] * Y.d[j][l];
      V4<T> w = {}, s = {};
      for (int k = 0; k < 3; ++k) {
        const V4<T> product = g[k] * (plane + field.slope[2] * Z.d[k][l]);
        w += product * Z.w[k][l];
        s += product * Z.s[k][l];
      }
      ww += w * Y.w[j][l];
      sw += w * Y.s[j][l];
      ws += s * Y.w[j][l];
    }
    sum[0] += ww * X.s[i][l];
    sum[1] += sw * X.w[i][l];
    sum[2] += ws * X.w[i][l];
  }
  for (int a = 0; a < 3; ++a) {
    const V4<T> all = sum[a] - field.slope[a] * value;
    work[a] = (all[0] + all[1]) + (all[2] + all[3]);
  }
}

// --- Loops over all particles --------------------------------------------------------------------------------------

template <typename T, typename One>
void ForBlocks(const Layout& layout, const Locations<T>& locations, int64_t env, int64_t first, int64_t end, const One& one) {
  Stencils<T> st;
  for (int64_t start = first; start < end; start += kBlock) {
    const int count = static_cast<int>(std::min<int64_t>(kBlock, end - start));
    Weigh(layout, locations, env, start, count, st);
    for (int l = 0; l < count; ++l) one(st, l, env * layout.particles + start + l);
  }
}

template <typename T>
void ScatterAll(ffi::ThreadPool& pool, const Layout& layout, const Locations<T>& locations, const FieldColumns<T>& field,
               int num_fields, T* const* out) {
  const int64_t pieces = std::clamp<int64_t>(layout.particles / kPiece, 1, kMostPieces);
  const int64_t size = (layout.particles + pieces - 1) / pieces;
  auto scatter = [&](int64_t env, int64_t piece, V4<T>* nodes) {
    std::memset(nodes, 0, layout.nodes * sizeof(V4<T>));
    ForBlocks(layout, locations, env, piece * size, std::min((piece + 1) * size, layout.particles),
              [&](const Stencils<T>& st, int l, int64_t i) { ScatterOne(st, l, field.At(i), nodes); });
  };
  if (pieces == 1) {
    ForEach(pool, layout.num_envs, [&](int64_t env) {
      V4<T>* nodes = Room<T>(room_of_task, layout.nodes);
      scatter(env, 0, nodes);
      Separate<T>(nodes, layout.nodes, env * layout.nodes, num_fields, out);
    });
    return;
  }
  V4<T>* sums = Room<T>(room_of_call, pieces * layout.nodes);
  for (int64_t env = 0; env < layout.num_envs; ++env) {
    ForEach(pool, pieces, [&](int64_t piece) { scatter(env, piece, sums + piece * layout.nodes); });
    const int64_t parts = (layout.nodes + kChunk - 1) / kChunk;
    ForEach(pool, parts, [&](int64_t part) {
      const int64_t first = part * kChunk, count = std::min(kChunk, layout.nodes - first);
      for (int64_t piece = 1; piece < pieces; ++piece) {
        for (int64_t i = first; i < first + count; ++i) sums[i] += sums[piece * layout.nodes + i];
      }
      Separate<T>(sums + first, count, env * layout.nodes + first, num_fields, out);
    });
  }
}

// one(stencils, lane, particle, nodes) for all particles, where nodes are those of the particle's environment.
template <typename T, typename One>
void GatherAll(ffi::ThreadPool& pool, const Layout& layout, const Locations<T>& locations, const T* const* fields,
               int num_fields, const One& one) {
  auto gather = [&](int64_t env, int64_t first, int64_t end, const V4<T>* nodes) {
    ForBlocks(layout, locations, env, first, end,
              [&](const Stencils<T>& st, int l, int64_t i) { one(st, l, i, nodes); });
  };
  const int64_t chunks = (layout.particles + kChunk - 1) / kChunk;
  if (layout.num_envs >= pool.num_threads() || chunks == 1) {
    ForEach(pool, layout.num_envs, [&](int64_t env) {
      V4<T>* nodes = Room<T>(room_of_task, layout.nodes);
      Interleave<T>(fields, num_fields, env * layout.nodes, layout.nodes, nodes);
      gather(env, 0, layout.particles, nodes);
    });
    return;
  }
  V4<T>* nodes = Room<T>(room_of_call, layout.nodes);
  for (int64_t env = 0; env < layout.num_envs; ++env) {
    Interleave<T>(fields, num_fields, env * layout.nodes, layout.nodes, nodes);
    ForEach(pool, chunks, [&](int64_t chunk) {
      gather(env, chunk * kChunk, std::min((chunk + 1) * kChunk, layout.particles), nodes);
    });
  }
}

// --- XLA's interface -----------------------------------------------------------------------------------------------

// Reads operands and results in order.
template <typename T>
struct Reader {
  ffi::RemainingArgs& args;
  ffi::RemainingRets& rets;
  size_t next_in = 0, next_out = 0;

  template <typename U>
  const U* In() { return static_cast<const U*>(args.get<ffi::AnyBuffer>(next_in++)->untyped_data()); }
  T* Out() { return static_cast<T*>((*rets.get<ffi::AnyBuffer>(next_out++))->untyped_data()); }
  template <int N>
  void Ins(const T* (&out)[N]) { for (auto& a : out) a = In<T>(); }
  template <int N>
  void Outs(T* (&out)[N]) { for (auto& a : out) a = Out(); }

  Locations<T> ReadLocations(const Layout& layout) {
    Locations<T> locations;
    Ins(locations.x);
    locations.offset = layout.listed ? In<int32_t>() : nullptr;
    return locations;
  }
  FieldColumns<T> ReadField(bool has_mass) {
    FieldColumns<T> field;
    field.mass = has_mass ? In<T>() : nullptr;
    Ins(field.value);
    for (auto& row : field.slope) Ins(row);
    return field;
  }
};

Layout ReadLayout(ffi::RemainingArgs& args, ffi::Span<const int64_t> sizes, ffi::Span<const double> box) {
  Layout layout;
  std::copy_n(sizes.begin(), 3, layout.shape);
  layout.nodes = sizes[3];
  layout.listed = sizes[4] != 0;
  std::copy_n(box.begin(), 3, layout.origin);
  layout.spacing = box[3];
  const auto dims = args.get<ffi::AnyBuffer>(0)->dimensions();
  layout.particles = dims.back();
  layout.num_envs = 1;
  for (size_t i = 0; i + 1 < dims.size(); ++i) layout.num_envs *= dims[i];
  return layout;
}

template <typename T>
void Scatter(ffi::ThreadPool& pool, const Layout& layout, Reader<T> io, int num_fields) {
  const Locations<T> locations = io.ReadLocations(layout);
  const FieldColumns<T> field = io.ReadField(num_fields == 4);
  T* out[4];
  for (int c = 0; c < num_fields; ++c) out[c] = io.Out();
  ScatterAll(pool, layout, locations, field, num_fields, out);
}

// Output arrays of moments: values of all fields, then the first moments of the vector field, row by row.
template <typename T>
struct MomentColumns {
  T *mass, *value[3], *first[3][3];
  explicit MomentColumns(Reader<T>& io, bool has_mass) {
    mass = has_mass ? io.Out() : nullptr;
    io.Outs(value);
    for (auto& row : first) io.Outs(row);
  }
  void Put(int64_t i, const Moments<T>& m) const {
    if (mass) mass[i] = m.value[3];
    for (int c = 0; c < 3; ++c) {
      value[c][i] = m.value[c];
      for (int a = 0; a < 3; ++a) first[c][a][i] = m.first[a][c];
    }
  }
};

template <typename T>
void GatherValues(ffi::ThreadPool& pool, const Layout& layout, Reader<T> io, int num_fields) {
  const Locations<T> locations = io.ReadLocations(layout);
  const T* fields[4];
  for (int c = 0; c < num_fields; ++c) fields[c] = io.template In<T>();
  const MomentColumns<T> out(io, num_fields == 4);
  GatherAll(pool, layout, locations, fields, num_fields,
            [&](const Stencils<T>& st, int l, int64_t i, const V4<T>* nodes) { out.Put(i, GatherOne(st, l, nodes)); });
}

template <typename T>
void ScatterTangentTranspose(ffi::ThreadPool& pool, const Layout& layout, Reader<T> io, int) {
  const Locations<T> locations = io.ReadLocations(layout);
  const FieldColumns<T> field = io.ReadField(true);
  const T* fields[4];
  io.Ins(fields);
  T* dx[3];
  io.Outs(dx);
  const MomentColumns<T> out(io, true);
  GatherAll(pool, layout, locations, fields, 4, [&](const Stencils<T>& st, int l, int64_t i, const V4<T>* nodes) {
    const Moments<T> m = GatherOne(st, l, nodes);
    out.Put(i, m);
    T work[3];
    WorkOne(st, l, field.At(i), nodes, m.value, work);
    for (int a = 0; a < 3; ++a) dx[a][i] = work[a];
  });
}

template <typename T>
void GatherTangentTranspose(ffi::ThreadPool& pool, const Layout& layout, Reader<T> io, int) {
  const Locations<T> locations = io.ReadLocations(layout);
  const T *nodes_of[3], *value_of[3];
  io.Ins(nodes_of);
  io.Ins(value_of);
  const FieldColumns<T> field = io.ReadField(false);
  T *dx[3], *out[3];
  io.Outs(dx);
  io.Outs(out);
  GatherAll(pool, layout, locations, nodes_of, 3, [&](const Stencils<T>& st, int l, int64_t i, const V4<T>* nodes) {
    const V4<T> value = {value_of[0][i], value_of[1][i], value_of[2][i], T(0)};
    T work[3];
    WorkOne(st, l, field.At(i), nodes, value, work);
    for (int a = 0; a < 3; ++a) dx[a][i] = work[a];
  });
  ScatterAll(pool, layout, locations, field, 3, out);
}

#define REWAX_KERNEL(name)                                                                                         \
  ffi::Error Run##name(ffi::ThreadPool pool, ffi::RemainingArgs args, ffi::RemainingRets rets,                   \
                       ffi::Span<const int64_t> sizes, ffi::Span<const double> box) {                            \
    const Layout layout = ReadLayout(args, sizes, box);                                                          \
    const int num_fields = static_cast<int>(sizes[5]);                                                           \
    if (args.get<ffi::AnyBuffer>(0)->element_type() == ffi::DataType::F64) {                                     \
      name<double>(pool, layout, Reader<double>{args, rets}, num_fields);                                        \
    } else {                                                                                                     \
      name<float>(pool, layout, Reader<float>{args, rets}, num_fields);                                          \
    }                                                                                                            \
    return ffi::Error::Success();                                                                                \
  }

REWAX_KERNEL(Scatter)
REWAX_KERNEL(GatherValues)
REWAX_KERNEL(ScatterTangentTranspose)
REWAX_KERNEL(GatherTangentTranspose)

}  // namespace

#define REWAX_EXPORT(symbol, name)                                                                                 \
  XLA_FFI_DEFINE_HANDLER_SYMBOL(symbol, Run##name,                                                                 \
                                ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets()            \
                                    .Attr<ffi::Span<const int64_t>>("sizes").Attr<ffi::Span<const double>>("box"))

REWAX_EXPORT(rewax_scatter, Scatter);
REWAX_EXPORT(rewax_gather_values, GatherValues);
REWAX_EXPORT(rewax_scatter_tangent_transpose, ScatterTangentTranspose);
REWAX_EXPORT(rewax_gather_tangent_transpose, GatherTangentTranspose);
