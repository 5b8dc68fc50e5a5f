// Runs a pointwise program on the elements of a mesh: gathers arrays over vertices at the elements' corners, and sums
// results at corners at the vertices. machine.py puts this text after machine.cc; assembled.py calls it.
//
// First all blocks of elements write their results at corners to planes [field][corner][element]. Then each vertex adds
// its entries of the planes, by corner and then by element. So threads share no sum, and their number changes no bit.

namespace {

constexpr int64_t kVerticesPerTask = 1024;

// Memory of this thread for results at corners. Other threads may write to it while this one waits for them.
T* Planes(size_t count) {
  static thread_local std::vector<char> memory;
  if (memory.size() < count * sizeof(T) + 64) memory = std::vector<char>(count * sizeof(T) + 64);
  return reinterpret_cast<T*>((reinterpret_cast<uintptr_t>(memory.data()) + 63) & ~static_cast<uintptr_t>(63));
}

// Layout of `sizes`: assembled.py, `_Layout`.
struct Elements {
  int64_t batch, count, blocks, block, vertices, num_corners, num_arguments, num_outputs, num_own, num_fields;
  int64_t num_tables, index_step, count_step;
  const int64_t *buffers, *corners, *steps, *outputs;

  explicit Elements(const int64_t* sizes) {
    int64_t* const head[] = {&batch, &count, &blocks, &block, &vertices, &num_corners, &num_arguments, &num_outputs,
                             &num_own, &num_fields, &num_tables, &index_step, &count_step};
    for (int64_t* field : head) *field = *sizes++;
    buffers = sizes;
    corners = buffers + num_arguments;
    steps = corners + num_arguments;
    outputs = steps + num_arguments;
  }
  int64_t plane_length() const { return blocks * block; }
};

// Sums the planes of kFields fields at vertices, by lists of their entries.
template <int kFields>
void SumListed(const int32_t* starts, const int32_t* entries, const T* planes, int64_t field_length, T* const* to,
               int64_t begin, int64_t end) {
  for (int64_t vertex = begin; vertex < end; ++vertex) {
    T sum[kFields] = {};
    for (int32_t k = starts[vertex]; k < starts[vertex + 1]; ++k) {
      for (int f = 0; f < kFields; ++f) sum[f] += planes[f * field_length + entries[k]];
    }
    for (int f = 0; f < kFields; ++f) to[f][vertex] = sum[f];
  }
}

class Assembler {
 public:
  Assembler(const Program& program, const Buffers& buffers, const Elements& e)
      : program_(program), buffers_(buffers), e_(e), operands_(static_cast<size_t>(e.num_arguments)),
        fields_(reinterpret_cast<T* const*>(buffers.results.data()) + e.num_own),
        tables_(reinterpret_cast<const int32_t* const*>(buffers.operands.data() + buffers.operands.size()) -
                e.num_tables) {
    for (int64_t k = 0; k < e.num_arguments; ++k) operands_[k] = buffers.operands[e.buffers[k]];
  }
  const void* const* operands() const { return operands_.data(); }
  int64_t planes_size() const { return e_.num_fields * e_.num_corners * e_.plane_length(); }
  int64_t num_sum_tasks() const {
    return listed() ? (e_.vertices + kVerticesPerTask - 1) / kVerticesPerTask : e_.num_fields;
  }

  // The elements of a block.
  void Evaluate(const SharedValues& shared, int64_t batch_element, int64_t block, T* planes) const {
    T* const sums = program_.num_sums
        ? static_cast<T*>(buffers_.results.back()) + (batch_element * e_.blocks + block) * program_.num_sums : nullptr;
    const int64_t begin = block * e_.block, last = std::min(begin + e_.block, e_.count);
    const int64_t end = std::max(begin, std::min(last, CountOf(batch_element)));
    const Assembly assembly{e_.corners, e_.outputs, tables_[0] + batch_element * e_.index_step, planes,
                            e_.plane_length()};
    if (begin < end) {
      Block{program_, shared.Of(batch_element), operands(), buffers_.results.data(), e_.steps, e_.count, batch_element,
            begin, end, &assembly}.Evaluate(sums);
    } else {
      std::fill(sums, sums + program_.num_sums, T(0));
    }
    if (end == last) return;
    for (const Row& row : program_.outputs) {
      const int64_t result = e_.outputs[row.array];
      if (result < 0) continue;
      char* const to = static_cast<char*>(buffers_.results[result]) +
                       ((batch_element * row.rows + row.row) * e_.count + end) * row.bytes;
      std::memset(to, 0, static_cast<size_t>((last - end) * row.bytes));
    }
  }

  // A part of the sums at vertices: a range of vertices, or a field.
  void Sum(int64_t batch_element, int64_t task, const T* planes) const {
    const int64_t length = e_.num_corners * e_.plane_length();
    std::vector<T*> to(fields_, fields_ + e_.num_fields);
    for (T*& field : to) field += batch_element * e_.vertices;
    if (listed()) {
      const int64_t begin = task * kVerticesPerTask, end = std::min(begin + kVerticesPerTask, e_.vertices);
      int64_t f = 0;
      for (; f + 3 <= e_.num_fields; f += 3) {
        SumListed<3>(tables_[1], tables_[2], planes + f * length, length, to.data() + f, begin, end);
      }
      for (; f < e_.num_fields; ++f) {
        SumListed<1>(tables_[1], tables_[2], planes + f * length, length, to.data() + f, begin, end);
      }
      return;
    }
    std::fill_n(to[task], e_.vertices, T(0));
    const int64_t count = CountOf(batch_element);
    for (int64_t corner = 0; corner < e_.num_corners; ++corner) {
      const int32_t* const at = tables_[0] + batch_element * e_.index_step + corner * e_.count;
      const T* const from = planes + task * length + corner * e_.plane_length();
      for (int64_t k = 0; k < count; ++k) to[task][at[k]] += from[k];
    }
  }

 private:
  bool listed() const { return e_.num_tables == 3; }
  int64_t CountOf(int64_t batch_element) const {
    return listed() ? e_.count : std::min<int64_t>(tables_[1][batch_element * e_.count_step], e_.count);
  }

  const Program& program_;
  const Buffers& buffers_;
  const Elements& e_;
  std::vector<const void*> operands_;
  T* const* fields_;
  const int32_t* const* tables_;
};

ffi::Error RunAssembled(ffi::ThreadPool pool, ffi::RemainingArgs args, ffi::RemainingRets rets, int64_t number,
                        ffi::Span<const int64_t> sizes) {
  const auto program = Find(number);
  if (!program) return ffi::Error::Internal("this program of rewax is not loaded");
  const Buffers buffers = BuffersOf(args, rets);
  const Elements e(sizes.begin());
  const Assembler assembler(*program, buffers, e);
  const SharedValues shared(*program, assembler.operands(), e.steps, e.batch);
  const int64_t length = assembler.planes_size(), tasks = assembler.num_sum_tasks();
  if (e.batch >= pool.num_threads()) {
    ForEach(pool, e.batch, [&](int64_t batch_element) {
      T* const planes = Planes(static_cast<size_t>(length));
      for (int64_t block = 0; block < e.blocks; ++block) assembler.Evaluate(shared, batch_element, block, planes);
      for (int64_t task = 0; task < tasks; ++task) assembler.Sum(batch_element, task, planes);
    });
    return ffi::Error::Success();
  }
  T* const planes = Planes(static_cast<size_t>(e.batch * length));
  ForEach(pool, e.batch * e.blocks, [&](int64_t task) {
    assembler.Evaluate(shared, task / e.blocks, task % e.blocks, planes + task / e.blocks * length);
  });
  ForEach(pool, e.batch * tasks, [&](int64_t task) {
    assembler.Sum(task / tasks, task % tasks, planes + task / tasks * length);
  });
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(REWAX_ASSEMBLED_HANDLER, RunAssembled,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets()
                                  .Attr<int64_t>("number").Attr<ffi::Span<const int64_t>>("sizes"));
