// Calls generated kernels (codegen.py) through XLA's foreign function interface, by their numbers, chunk by chunk.
//
// kernels.py builds this file after threads.h. The kernels know nothing of XLA, so each compiles in a second.

#include <cstdint>
#include <mutex>
#include <unordered_map>
#include <vector>

namespace {

typedef void (*Kernel)(const void* const* operands, void* const* results, const int64_t* sizes, int64_t copy,
                       int64_t chunk, int64_t begin, int64_t end);

std::mutex mutex;
std::unordered_map<int64_t, Kernel>& Kernels() {
  static auto* kernels = new std::unordered_map<int64_t, Kernel>;
  return *kernels;
}

ffi::Error RunPointwise(ffi::ThreadPool pool, ffi::RemainingArgs args, ffi::RemainingRets rets, int64_t number,
                        ffi::Span<const int64_t> sizes) {
  Kernel kernel;
  {
    std::lock_guard<std::mutex> lock(mutex);
    const auto found = Kernels().find(number);
    if (found == Kernels().end()) return ffi::Error::Internal("this kernel of rewax is not loaded");
    kernel = found->second;
  }
  std::vector<const void*> operands(args.size());
  std::vector<void*> results(rets.size());
  for (size_t k = 0; k < operands.size(); ++k) operands[k] = args.get<ffi::AnyBuffer>(k)->untyped_data();
  for (size_t k = 0; k < results.size(); ++k) results[k] = (*rets.get<ffi::AnyBuffer>(k))->untyped_data();
  const int64_t copies = sizes[0], count = sizes[1], chunks = sizes[2], size = sizes[3];
  ForEach(pool, copies * chunks, [&](int64_t task) {
    const int64_t chunk = task % chunks, begin = chunk * size;
    kernel(operands.data(), results.data(), sizes.begin() + 1, task / chunks, chunk, begin, std::min(begin + size, count));
  });
  return ffi::Error::Success();
}

}  // namespace

extern "C" void rewax_add_kernel(int64_t number, Kernel kernel) {
  std::lock_guard<std::mutex> lock(mutex);
  Kernels()[number] = kernel;
}

XLA_FFI_DEFINE_HANDLER_SYMBOL(rewax_pointwise, RunPointwise,
                              ffi::Ffi::Bind().Ctx<ffi::ThreadPool>().RemainingArgs().RemainingRets()
                                  .Attr<int64_t>("number").Attr<ffi::Span<const int64_t>>("sizes"));
