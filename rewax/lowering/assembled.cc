// Runs a pointwise program on the elements of a mesh: gathers arrays over vertices at the elements' corners, and sums
// results at corners at the vertices. machine.py puts this text after machine.cc; assembled.py calls it.
//
// First all blocks of elements write their results at corners to records. Then each vertex adds its records, by corner
// and then by element. So threads share no sum, and their number changes no bit.

namespace {

constexpr int64_t kVerticesPerTask = 1024;

// Memory of this thread. Other threads may write to it while this one waits for them.
T* Shareable(int64_t count) {
  static thread_local std::vector<char> memory;
  const size_t size = static_cast<size_t>(count) * sizeof(T) + 64;
  if (memory.size() < size) memory = std::vector<char>(size);
  return reinterpret_cast<T*>((reinterpret_cast<uintptr_t>(memory.data()) + 63) & ~static_cast<uintptr_t>(63));
}

// The layout of `sizes`: `_sizes` of assembled.py.
struct Mesh {
  int64_t batch, count, blocks, block, vertices, num_corners, num_arguments, num_own, num_written, num_tables;
  int64_t index_step, count_step, num_read;
  const int64_t* fields;  // for each field that is read: its array and the array's step
  const int64_t *arrays, *reads, *steps;  // for each argument
  const int64_t* outputs;

  explicit Mesh(const int64_t* sizes) {
    int64_t* const head[] = {&batch, &count, &blocks, &block, &vertices, &num_corners, &num_arguments, &num_own,
                             &num_written, &num_tables, &index_step, &count_step, &num_read};
    for (int64_t* number : head) *number = *sizes++;
    fields = sizes;
    arrays = fields + 2 * num_read;
    reads = arrays + num_arguments;
    steps = reads + num_arguments;
    outputs = steps + num_arguments;
  }
  int64_t read_quads() const { return (num_read + 3) / 4; }
  int64_t written_quads() const { return (num_written + 3) / 4; }
  // Numbers of a vertex's fields and of a record. A single number needs no group of four.
  int64_t read_stride() const { return num_read == 1 ? 1 : 4 * read_quads(); }
  int64_t written_stride() const { return num_written == 1 && !listed() ? 1 : 4 * written_quads(); }
  int64_t plane_length() const { return blocks * block; }
  bool listed() const { return num_tables == 2; }
  // Memory for the fields, the records, and the sums of a list, in numbers.
  int64_t fields_size() const { return (read_stride() * vertices + 15) / 16 * 16; }
  int64_t records_size() const { return written_stride() * num_corners * plane_length(); }
  int64_t sums_size() const { return listed() ? 4 * written_quads() * vertices : 0; }
  int64_t memory_size() const { return fields_size() + records_size() + sums_size(); }
  int64_t num_sum_tasks() const {
    if (!num_written) return 0;
    return listed() ? 1 : (vertices + kVerticesPerTask - 1) / kVerticesPerTask;
  }
};

class Assembler {
 public:
  Assembler(const Program& program, const Buffers& buffers, const Mesh& mesh)
      : program_(program), buffers_(buffers), mesh_(mesh),
        tables_(reinterpret_cast<const int32_t* const*>(buffers.operands.data() + buffers.operands.size()) -
                mesh.num_tables) {
    for (int64_t k = 0; k < mesh.num_arguments; ++k) operands_.push_back(buffers.operands[mesh.arrays[k]]);
  }
  const void* const* operands() const { return operands_.data(); }

  // Packs the fields of a batch element.
  void Prepare(int64_t batch_element, T* memory) const {
    if (mesh_.read_stride() == 1) {
      const T* const from = static_cast<const T*>(buffers_.operands[mesh_.fields[0]]) + batch_element * mesh_.fields[1];
      std::copy(from, from + mesh_.vertices, memory);
      return;
    }
    const T* rows[4];
    for (int64_t f = 0; f < mesh_.num_read; f += 4) {
      for (int64_t k = 0; k < 4; ++k) {
        const int64_t* const field = mesh_.fields + 2 * std::min(f + k, mesh_.num_read - 1);
        rows[k] = static_cast<const T*>(buffers_.operands[field[0]]) + batch_element * field[1];
      }
      Pack(rows, memory + f, 4 * mesh_.read_quads(), mesh_.vertices);
    }
  }

  // The elements of a block.
  void Evaluate(const SharedValues& shared, int64_t batch_element, int64_t block, T* memory) const {
    const int64_t task = batch_element * mesh_.blocks + block;
    T* const sums = program_.num_sums ? static_cast<T*>(buffers_.results.back()) + task * program_.num_sums : nullptr;
    const int64_t begin = block * mesh_.block, last = std::min(begin + mesh_.block, mesh_.count);
    const int64_t end = std::max(begin, std::min(last, CountOf(batch_element)));
    const Corners corners{mesh_.reads, mesh_.outputs, Index(batch_element), mesh_.count, mesh_.num_corners, memory,
                          memory + mesh_.fields_size(), mesh_.read_quads(), mesh_.written_quads(), mesh_.read_stride(),
                          mesh_.written_stride(), mesh_.plane_length()};
    if (begin < end) {
      Block{program_, shared.Of(batch_element), operands(), buffers_.results.data(), mesh_.steps, mesh_.count,
            batch_element, begin, end, &corners}.Evaluate(sums);
    } else {
      std::fill(sums, sums + program_.num_sums, T(0));
    }
    if (end == last) return;
    for (const Row& row : program_.outputs) {
      const int64_t result = mesh_.outputs[row.array];
      if (result < 0) continue;
      char* const to = static_cast<char*>(buffers_.results[result]) +
                       ((batch_element * row.rows + row.row) * mesh_.count + end) * row.bytes;
      std::memset(to, 0, static_cast<size_t>((last - end) * row.bytes));
    }
  }

  // Sums at a range of vertices; of a list of elements, at all vertices.
  void Sum(int64_t batch_element, int64_t task, T* memory) const {
    const int64_t quads = mesh_.written_quads(), stride = 4 * quads;
    const T* const records = memory + mesh_.fields_size();
    std::vector<T*> to(static_cast<size_t>(stride));
    for (int64_t f = 0; f < mesh_.num_written; ++f) {
      to[f] = static_cast<T*>(buffers_.results[mesh_.num_own + f]) + batch_element * mesh_.vertices;
    }
    if (mesh_.listed()) return SumList(batch_element, records, memory + mesh_.fields_size() + mesh_.records_size(), to);
    const int64_t begin = task * kVerticesPerTask, end = std::min(begin + kVerticesPerTask, mesh_.vertices);
    if (mesh_.written_stride() == 1) return SumNumbers(tables_[1], tables_[2], records, to[0], begin, end);
    int64_t q = 0;
    for (; q + 2 <= quads; q += 2) {
      SumListed<2>(tables_[1], tables_[2], records + 4 * q, stride, to.data() + 4 * q, begin, end);
    }
    if (q < quads) SumListed<1>(tables_[1], tables_[2], records + 4 * q, stride, to.data() + 4 * q, begin, end);
  }

 private:
  const int32_t* Index(int64_t batch_element) const { return tables_[0] + batch_element * mesh_.index_step; }
  int64_t CountOf(int64_t batch_element) const {
    return mesh_.listed() ? std::min<int64_t>(tables_[1][batch_element * mesh_.count_step], mesh_.count) : mesh_.count;
  }

  void SumList(int64_t batch_element, const T* records, T* sums, const std::vector<T*>& to) const {
    const int64_t quads = mesh_.written_quads(), count = CountOf(batch_element);
    std::fill_n(sums, mesh_.sums_size(), T(0));
    for (int64_t corner = 0; corner < mesh_.num_corners; ++corner) {
      const int32_t* const at = Index(batch_element) + corner * mesh_.count;
      const T* from = records + 4 * quads * corner * mesh_.plane_length();
      for (int64_t k = 0; k < count; ++k, from += 4 * quads) {
        T* const own = sums + 4 * quads * at[k];
        for (int64_t q = 0; q < 4 * quads; q += 4) Store(own + q, Load(own + q) + Load(from + q));
      }
    }
    for (int64_t f = 0; f < mesh_.num_written; ++f) {
      for (int64_t v = 0; v < mesh_.vertices; ++v) to[f][v] = sums[4 * quads * v + f];
    }
  }

  const Program& program_;
  const Buffers& buffers_;
  const Mesh& mesh_;
  const int32_t* const* tables_;
  std::vector<const void*> operands_;
};

ffi::Error RunAssembled(ffi::ThreadPool pool, ffi::RemainingArgs args, ffi::RemainingRets rets, int64_t number,
                        ffi::Span<const int64_t> sizes) {
  const auto program = Find(number);
  if (!program) return ffi::Error::Internal("this program of rewax is not loaded");
  const Buffers buffers = BuffersOf(args, rets);
  const Mesh mesh(sizes.begin());
  const Assembler assembler(*program, buffers, mesh);
  const SharedValues shared(*program, assembler.operands(), mesh.steps, mesh.batch);
  const int64_t length = mesh.memory_size(), tasks = mesh.num_sum_tasks(), blocks = mesh.blocks;
  if (mesh.batch >= pool.num_threads()) {
    ForEach(pool, mesh.batch, [&](int64_t batch_element) {
      T* const memory = Shareable(length);
      assembler.Prepare(batch_element, memory);
      for (int64_t block = 0; block < blocks; ++block) assembler.Evaluate(shared, batch_element, block, memory);
      for (int64_t task = 0; task < tasks; ++task) assembler.Sum(batch_element, task, memory);
    });
    return ffi::Error::Success();
  }
  T* const memory = Shareable(mesh.batch * length);
  for (int64_t batch_element = 0; batch_element < mesh.batch; ++batch_element) {
    assembler.Prepare(batch_element, memory + batch_element * length);
  }
  ForEach(pool, mesh.batch * blocks, [&](int64_t task) {
    assembler.Evaluate(shared, task / blocks, task % blocks, memory + task / blocks * length);
  });
  ForEach(pool, mesh.batch * tasks, [&](int64_t task) {
    assembler.Sum(task / tasks, task % tasks, memory + task / tasks * length);
  });
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(REWAX_ASSEMBLED_HANDLER, RunAssembled,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets()
                                  .Attr<int64_t>("number").Attr<ffi::Span<const int64_t>>("sizes"));
