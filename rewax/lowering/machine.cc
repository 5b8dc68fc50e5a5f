// Runs bytecode (assembler.py) through XLA's foreign function interface, for many batch elements at once.
//
// machine.py puts this text after threads.h, lanes.h, the enum of special instructions and the macros REWAX_CASES (the
// code of each instruction), REWAX_LANES_HANDLER and REWAX_BLOCKS_HANDLER (the handlers' names).
//
// There are two ways to fill vectors. A program of small arrays (articulated bodies) has one batch element in each
// lane: it gathers numbers from arrays at its beginning, and each register is one vector. A pointwise program has
// neighbouring elements in the lanes: a register is a block of vectors, and instructions read operands from the
// arguments and write results to the outputs directly.

#include <memory>
#include <mutex>
#include <unordered_map>
#include <vector>

namespace {

typedef V AnywhereV __attribute__((aligned(sizeof(T)), may_alias));

template <typename X>
inline X Get(const T* from) {
  return (X) * reinterpret_cast<const AnywhereV*>(from);
}
inline void Put(T* to, V a) { *reinterpret_cast<AnywhereV*>(to) = a; }
inline void Put(T* to, VI a) { Put(to, (V)a); }
// Broadcasts a value that all elements share to all lanes.
template <typename X>
inline X Shared(const T* from) {
  UI bits;
  std::memcpy(&bits, from, sizeof(bits));
  return (X)Wide(bits);
}

// Lane l holds a batch element. Its arrays begin l * step numbers after those of the first; with a step of 0 all batch
// elements share one array. Lanes beyond the last batch element repeat it.
inline V Gather(const T* from, int64_t step, int count) {
  if (step == 0) return Full<V>(*from);
  V r;
  for (int l = 0; l < kLanes; ++l) r[l] = from[(l < count ? l : count - 1) * step];
  return r;
}
template <typename S>
inline VI GatherIntegers(const S* from, int64_t step, int count) {
  VI r;
  for (int l = 0; l < kLanes; ++l) r[l] = static_cast<decltype(+r[0])>(from[(l < count ? l : count - 1) * step]);
  return r;
}

// A sequence of runs: an instruction, its number of repetitions, and its registers for each repetition.
struct Code {
  std::vector<int32_t> code;
  std::vector<T> constants;
  int64_t num_registers;
};

// Location of one number of each element: index of the array, index of the row, number of rows, bytes per number.
struct Row {
  int32_t array, row, rows, bytes;
};

struct Program {
  Code lanes;  // in a pointwise program: the values that all elements share
  Code blocks;
  int64_t num_sums = 0;
  std::vector<int32_t> shared;        // registers of `lanes` that `blocks` reads
  std::vector<Row> inputs, outputs;
};

std::mutex mutex;
std::unordered_map<int64_t, std::shared_ptr<const Program>>& Programs() {
  static auto* programs = new std::unordered_map<int64_t, std::shared_ptr<const Program>>;
  return *programs;
}
std::shared_ptr<const Program> Find(int64_t number) {
  std::lock_guard<std::mutex> lock(mutex);
  const auto found = Programs().find(number);
  return found == Programs().end() ? nullptr : found->second;
}

// Aligned memory of this thread for `count` vectors.
V* Scratch(size_t count) {
  static thread_local std::vector<char> memory;
  if (memory.size() < count * sizeof(V) + 64) memory.resize(count * sizeof(V) + 64);
  return reinterpret_cast<V*>((reinterpret_cast<uintptr_t>(memory.data()) + 63) & ~static_cast<uintptr_t>(63));
}

// Data of one run: registers that are vectors (lanes), or addresses of registers that are blocks.
struct Frame {
  T* registers;
  const T* constants;
  const void* const* operands;
  void* const* results;
  const int64_t* steps;
  size_t num_operands;
  int64_t first;
  int count;

  T* const* addresses;
  V* sums;
  int vectors, left;  // number of vectors of a block; elements of its last vector
};

// Sum of a block's vectors; the last vector has `left` elements.
template <typename Vectors>
inline V SumOf(int64_t end, int left, const Vectors& vector) {
  V even{}, odd{};
  const int64_t last = end - kLanes;
  int64_t k = 0;
  for (; k + kLanes < last; k += 2 * kLanes) {
    even += vector(k);
    odd += vector(k + kLanes);
  }
  if (k < last) even += vector(k);
  return even + (odd + Part(vector(last), left));
}

// Whether a boolean is true in one of the first lanes.
inline bool AnyOf(const char* lanes, int count) {
  for (size_t k = 0; k < static_cast<size_t>(count) * sizeof(T); k += sizeof(T)) {
    if (lanes[k]) return true;
  }
  return false;
}

#define REPEAT(width) for (; times; --times, at += (width))
#define OPERAND(k) (kBlocks ? addresses[at[k]] : registers + static_cast<int64_t>(at[k]) * kLanes)
#define EACH for (int64_t k = 0; k < end; k += kLanes)

template <bool kBlocks>
void Run(const Code& program, const Frame& f) {
  const int64_t end = (kBlocks ? f.vectors : 1) * kLanes;
  T* const registers = f.registers;  // in local variables, because stores could alias the fields of f
  T* const* const addresses = f.addresses;
  const int32_t* at = program.code.data();
  const int32_t* const stop = at + program.code.size();
  while (at != stop) {
    const int32_t instruction = at[0];
    int32_t times = at[1];
    at += 2;
    switch (instruction) {
      REWAX_CASES
      case kConstant:
        REPEAT(2) Put(OPERAND(0), Shared<V>(f.constants + at[1]));  // the bits of a value of any type
        break;
#define REWAX_FROM(S) static_cast<const S*>(f.operands[at[1]]) + f.first * f.steps[at[1]] + at[2], f.steps[at[1]], f.count
      case kLoadFloat:
        REPEAT(3) Put(OPERAND(0), Gather(REWAX_FROM(T)));
        break;
      case kLoadInt32:
        REPEAT(3) Put(OPERAND(0), GatherIntegers(REWAX_FROM(int32_t)));
        break;
      case kLoadInt64:
        REPEAT(3) Put(OPERAND(0), GatherIntegers(REWAX_FROM(int64_t)));
        break;
      case kLoadBool:
        REPEAT(3) Put(OPERAND(0), -GatherIntegers(REWAX_FROM(bool)));
        break;
      case kStore:
        REPEAT(3) {
          const int64_t step = f.steps[f.num_operands + static_cast<size_t>(at[1])];
          T* const to = static_cast<T*>(f.results[at[1]]) + f.first * step + at[2];
          const V a = Get<V>(OPERAND(0));
          for (int l = 0; l < f.count; ++l) to[l * step] = a[l];
        }
        break;
      case kConvertInt32:
        REPEAT(2) EACH Put(OPERAND(0) + k, LoadIntegers(reinterpret_cast<const int32_t*>(OPERAND(1)) + k, kLanes));
        break;
      case kConvertInt64:
        REPEAT(2) EACH Put(OPERAND(0) + k, LoadIntegers(reinterpret_cast<const int64_t*>(OPERAND(1)) + k, kLanes));
        break;
      case kConvertBool:
        REPEAT(2) EACH Put(OPERAND(0) + k, LoadBooleans(reinterpret_cast<const bool*>(OPERAND(1)) + k, kLanes));
        break;
      case kStoreBool:
        REPEAT(2) EACH StoreBooleans(reinterpret_cast<bool*>(OPERAND(0)) + k, Get<VI>(OPERAND(1) + k), kLanes);
        break;
      case kSum:
        REPEAT(2) {
          const T* const a = OPERAND(1);
          f.sums[at[0]] += SumOf(end, f.left, [=](int64_t k) { return Get<V>(a + k); });
        }
        break;
      case kSumOfProducts:
        REPEAT(3) {
          const T *const a = OPERAND(1), *const b = OPERAND(2);
          f.sums[at[0]] += SumOf(end, f.left, [=](int64_t k) { return Get<V>(a + k) * Get<V>(b + k); });
        }
        break;
      case kLoopExit:  // of lanes: a condition, and the distance to what follows the loop
        at += AnyOf(reinterpret_cast<const char*>(OPERAND(0)), f.count) ? 2 : at[1];
        break;
      case kLoopBack:
        at -= at[0];
        break;
      default:
        return;
    }
  }
}

// Addresses of arguments and results.
struct Buffers {
  std::vector<const void*> operands;
  std::vector<void*> results;
};
Buffers BuffersOf(const ffi::RemainingArgs& args, const ffi::RemainingRets& rets) {
  Buffers found;
  for (size_t k = 0; k < args.size(); ++k) found.operands.push_back(args.get<ffi::AnyBuffer>(k)->untyped_data());
  for (size_t k = 0; k < rets.size(); ++k) found.results.push_back((*rets.get<ffi::AnyBuffer>(k))->untyped_data());
  return found;
}

ffi::Error RunLanes(ffi::ThreadPool pool, ffi::RemainingArgs args, ffi::RemainingRets rets, int64_t number,
                    ffi::Span<const int64_t> sizes) {
  const auto program = Find(number);
  if (!program) return ffi::Error::Internal("this program of rewax is not loaded");
  const Buffers buffers = BuffersOf(args, rets);
  const auto &operands = buffers.operands;
  const auto &results = buffers.results;
  const int64_t batch = sizes[0];
  ForEach(pool, (batch + kLanes - 1) / kLanes, [&](int64_t group) {
    Frame f{};
    f.registers = reinterpret_cast<T*>(Scratch(static_cast<size_t>(program->lanes.num_registers)));
    f.constants = program->lanes.constants.data();
    f.operands = operands.data();
    f.results = results.data();
    f.steps = sizes.begin() + 1;
    f.num_operands = operands.size();
    f.first = group * kLanes;
    f.count = static_cast<int>(std::min<int64_t>(kLanes, batch - f.first));
    Run<false>(program->lanes, f);
  });
  return ffi::Error::Success();
}

// The elements [begin, end) of one batch element of a pointwise program.
struct Block {
  const Program& program;
  const T* shared;
  const void* const* operands;
  void* const* results;
  const int64_t* steps;
  int64_t count, batch_element, begin, end;
  const Corners* corners;  // null unless the elements are those of a mesh

  char* Address(const Row& row, const void* array, int64_t step) const {
    return static_cast<char*>(const_cast<void*>(array)) + (batch_element * step + row.row * count + begin) * row.bytes;
  }
  int64_t Read(const Row& row) const { return corners ? corners->reads[row.array] : -1; }
  int64_t ResultOf(const Row& row) const { return corners ? corners->outputs[row.array] : row.array; }

  void Evaluate(T* sums) const {
    const int64_t size = end - begin, vectors = (size + kLanes - 1) / kLanes;
    const bool full = size % kLanes == 0;
    const size_t registers = static_cast<size_t>(program.blocks.num_registers);
    const size_t num_sums = static_cast<size_t>(program.num_sums), length = static_cast<size_t>(vectors);
    // If the last vector is not full, rows are copied. Their numbers have at most eight bytes. Values at corners have
    // rows of their own, which are filled by four numbers at a time.
    const size_t num_rows = program.inputs.size() + program.outputs.size(), row_size = length * (8 / sizeof(T)) + 2;
    const size_t num_copies = full && !corners ? 0 : (num_rows + 1) * row_size;
    const size_t num_addresses = registers + program.shared.size() + num_rows;
    V* const memory = Scratch(registers * length + num_copies + num_sums + num_addresses * sizeof(T*) / sizeof(V) + 1);
    V* copies = memory + registers * length;
    V* const totals = copies + num_copies;
    T** const addresses = reinterpret_cast<T**>(totals + num_sums);
    std::fill(totals, totals + num_sums, V{});
    std::vector<T*> read, written;
    T* const unwanted = reinterpret_cast<T*>(copies);
    if (corners) {
      copies += row_size;
      read.resize(static_cast<size_t>(4 * corners->num_corners * corners->read_quads));
      written.resize(static_cast<size_t>(4 * corners->num_corners * corners->written_quads));
    }

    T** address = addresses;
    for (size_t k = 0; k < registers; ++k) *address++ = reinterpret_cast<T*>(memory + k * length);
    for (int32_t k : program.shared) *address++ = const_cast<T*>(shared + k * kLanes);
    for (const Row& row : program.inputs) {
      const int64_t at_corner = Read(row);
      char* from = reinterpret_cast<char*>(copies);
      if (at_corner < 0) from = Address(row, operands[row.array], steps[row.array]);
      if (at_corner >= 0) read[static_cast<size_t>(at_corner)] = reinterpret_cast<T*>(from);
      else if (!full) from = Repeated(from, reinterpret_cast<char*>(copies), row.bytes, size, vectors * kLanes);
      if (at_corner >= 0 || !full) copies += row_size;
      *address++ = reinterpret_cast<T*>(from);
    }
    T** const first_output = address;
    for (const Row& row : program.outputs) {
      const int64_t result = ResultOf(row);
      const bool direct = full && result >= 0;
      char* const to = direct ? Address(row, results[result], row.rows * count) : reinterpret_cast<char*>(copies);
      if (result < 0) written[static_cast<size_t>(-1 - result)] = reinterpret_cast<T*>(to);
      *address++ = reinterpret_cast<T*>(to);
      if (!direct) copies += row_size;
    }

    Frame f{};
    f.addresses = addresses;
    f.sums = totals;
    f.vectors = static_cast<int>(vectors);
    f.left = static_cast<int>(size - (vectors - 1) * kLanes);
    if (corners) corners->Gather(read.data(), unwanted, begin, size, vectors * kLanes);
    Run<true>(program.blocks, f);
    if (corners) corners->Write(written.data(), unwanted, begin, size);
    address = first_output;
    for (const Row& row : program.outputs) {
      const T* const from = *address++;
      const int64_t result = ResultOf(row);
      if (full || result < 0) continue;
      std::memcpy(Address(row, results[result], row.rows * count), from, static_cast<size_t>(size * row.bytes));
    }
    for (size_t k = 0; k < num_sums; ++k) sums[k] = Total(totals[k]);
  }

  // A copy of a row whose last value is repeated.
  static char* Repeated(const char* from, char* to, int64_t bytes, int64_t count, int64_t full) {
    std::memcpy(to, from, static_cast<size_t>(count * bytes));
    const char* const last = to + (count - 1) * bytes;
    for (int64_t l = count; l < full; ++l) std::memcpy(to + l * bytes, last, static_cast<size_t>(bytes));
    return to;
  }
};

// The values that all elements of a batch element share.
struct SharedValues {
  int64_t registers;
  std::vector<T> memory;
  T* aligned;

  SharedValues(const Program& program, const void* const* operands, const int64_t* steps, int64_t batch)
      : registers(program.lanes.num_registers * kLanes), memory(static_cast<size_t>(batch * registers + kLanes)) {
    const auto address = reinterpret_cast<uintptr_t>(memory.data());
    aligned = reinterpret_cast<T*>((address + sizeof(V) - 1) / sizeof(V) * sizeof(V));
    for (int64_t batch_element = 0; batch_element < batch; ++batch_element) {
      Frame f{};
      f.registers = aligned + batch_element * registers;
      f.constants = program.lanes.constants.data();
      f.operands = operands;
      f.steps = steps;
      f.first = batch_element;
      f.count = 1;
      Run<false>(program.lanes, f);
    }
  }
  const T* Of(int64_t batch_element) const { return aligned + batch_element * registers; }
};

ffi::Error RunBlocks(ffi::ThreadPool pool, ffi::RemainingArgs args, ffi::RemainingRets rets, int64_t number,
                     ffi::Span<const int64_t> sizes) {
  const auto program = Find(number);
  if (!program) return ffi::Error::Internal("this program of rewax is not loaded");
  const Buffers buffers = BuffersOf(args, rets);
  const auto &operands = buffers.operands;
  const auto &results = buffers.results;
  const int64_t batch = sizes[0], count = sizes[1], blocks = sizes[2], block = sizes[3];
  const int64_t* const steps = sizes.begin() + 4;
  const SharedValues shared(*program, operands.data(), steps, batch);
  ForEach(pool, batch * blocks, [&](int64_t task) {
    const int64_t batch_element = task / blocks, begin = task % blocks * block;
    T* const sums = program->num_sums ? static_cast<T*>(results.back()) + task * program->num_sums : nullptr;
    const int64_t end = std::min(begin + block, count);
    Block{*program, shared.Of(batch_element), operands.data(), results.data(), steps, count, batch_element, begin, end,
          nullptr}.Evaluate(sums);
  });
  return ffi::Error::Success();
}

}  // namespace

// Args: number of the program; its code of lanes and of blocks; the constants of lanes; `layout`: counts of registers of
// lanes and of blocks, sums, shared registers, inputs and outputs, then the shared registers and the rows.
extern "C" void rewax_add_program(int64_t number, const int32_t* lanes, int64_t lanes_length, const int32_t* blocks,
                                  int64_t blocks_length, const T* constants, int64_t num_constants, const int32_t* layout) {
  auto program = std::make_shared<Program>();
  program->lanes = {{lanes, lanes + lanes_length}, {constants, constants + num_constants}, layout[0]};
  program->blocks = {{blocks, blocks + blocks_length}, {}, layout[1]};
  program->num_sums = layout[2];
  const int32_t num_shared = layout[3], num_inputs = layout[4], num_outputs = layout[5];
  layout += 6;
  program->shared.assign(layout, layout + num_shared);
  layout += num_shared;
  for (int32_t k = 0; k < num_inputs + num_outputs; ++k, layout += 4) {
    (k < num_inputs ? program->inputs : program->outputs).push_back({layout[0], layout[1], layout[2], layout[3]});
  }
  std::lock_guard<std::mutex> lock(mutex);
  Programs()[number] = std::move(program);
}

XLA_FFI_DEFINE_HANDLER_SYMBOL(REWAX_LANES_HANDLER, RunLanes,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets()
                                  .Attr<int64_t>("number").Attr<ffi::Span<const int64_t>>("sizes"));
XLA_FFI_DEFINE_HANDLER_SYMBOL(REWAX_BLOCKS_HANDLER, RunBlocks,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets()
                                  .Attr<int64_t>("number").Attr<ffi::Span<const int64_t>>("sizes"));
