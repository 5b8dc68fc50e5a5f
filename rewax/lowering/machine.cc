// Evaluates tapes (machine.py) for many copies of a program at once, through XLA's foreign function interface.
//
// machine.py builds this file after threads.h, lanes.h and the macros REWAX_CASES, the code of each instruction, and
// REWAX_TAPE, the handler's name.

#include <memory>
#include <mutex>
#include <unordered_map>
#include <vector>

namespace {

struct Tape {
  std::vector<int32_t> code;
  std::vector<T> constants;
  int64_t num_slots;
};

std::mutex mutex;
std::unordered_map<int64_t, std::shared_ptr<const Tape>>& Tapes() {
  static auto* tapes = new std::unordered_map<int64_t, std::shared_ptr<const Tape>>;
  return *tapes;
}

// Lane l is a copy of the program, whose arrays begin l * step numbers after those of the first; with a step of 0 all
// copies have the same. Lanes beyond the last copy repeat it.
inline V Gather(const T* from, int64_t step, int count) {
  if (step == 0) return Full<V>(*from);
  V r;
  for (int l = 0; l < kLanes; ++l) r[l] = from[(l < count ? l : count - 1) * step];
  return r;
}
template <typename S>
inline VI GatherWhole(const S* from, int64_t step, int count) {
  VI r;
  for (int l = 0; l < kLanes; ++l) r[l] = static_cast<decltype(+r[0])>(from[(l < count ? l : count - 1) * step]);
  return r;
}

// The code is a row of runs: an instruction, how often, and for each time its places.
void Evaluate(const Tape& tape, V* s, const void* const* operands, void* const* results, const int64_t* steps,
              int64_t first, int count) {
  const size_t num_operands = static_cast<size_t>(steps[-1]);
  const int32_t* at = tape.code.data();
  const int32_t* const end = at + tape.code.size();
  while (at != end) {
    const int32_t instruction = at[0];
    int32_t times = at[1];
    at += 2;
    switch (instruction) {
      REWAX_CASES
      default:
        return;
    }
  }
}

ffi::Error RunTape(ffi::ThreadPool pool, ffi::RemainingArgs args, ffi::RemainingRets rets, int64_t number,
                   ffi::Span<const int64_t> sizes) {
  std::shared_ptr<const Tape> tape;
  {
    std::lock_guard<std::mutex> lock(mutex);
    const auto found = Tapes().find(number);
    if (found == Tapes().end()) return ffi::Error::Internal("this tape of rewax is not loaded");
    tape = found->second;
  }
  std::vector<const void*> operands(args.size());
  std::vector<void*> results(rets.size());
  for (size_t k = 0; k < operands.size(); ++k) operands[k] = args.get<ffi::AnyBuffer>(k)->untyped_data();
  for (size_t k = 0; k < results.size(); ++k) results[k] = (*rets.get<ffi::AnyBuffer>(k))->untyped_data();
  const int64_t copies = sizes[0];
  ForEach(pool, (copies + kLanes - 1) / kLanes, [&](int64_t block) {
    static thread_local std::vector<V> slots;
    if (slots.size() < static_cast<size_t>(tape->num_slots)) slots.resize(static_cast<size_t>(tape->num_slots));
    const int64_t first = block * kLanes;
    Evaluate(*tape, slots.data(), operands.data(), results.data(), sizes.begin() + 2, first,
             static_cast<int>(std::min<int64_t>(kLanes, copies - first)));
  });
  return ffi::Error::Success();
}

}  // namespace

extern "C" void rewax_add_tape(int64_t number, const int32_t* code, int64_t length, const T* constants,
                               int64_t num_constants, int64_t num_slots) {
  auto tape = std::make_shared<Tape>();
  tape->code.assign(code, code + length);
  tape->constants.assign(constants, constants + num_constants);
  tape->num_slots = num_slots;
  std::lock_guard<std::mutex> lock(mutex);
  Tapes()[number] = std::move(tape);
}

XLA_FFI_DEFINE_HANDLER_SYMBOL(REWAX_TAPE, RunTape,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets()
                                  .Attr<int64_t>("number").Attr<ffi::Span<const int64_t>>("sizes"));
