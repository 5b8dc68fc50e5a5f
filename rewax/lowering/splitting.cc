// Splits each row of a matrix into pieces, one buffer per piece, through XLA's foreign function interface.
//
// machine.py puts this text after machine.cc: a library of its own would parse XLA's headers once more.
// The macro REWAX_SPLIT_HANDLER is the handler's name.

#include <cstring>
#include <utility>
#include <vector>

namespace {

ffi::Error Split(ffi::AnyBuffer vectors, ffi::RemainingRets pieces) {
  const size_t num_rows = static_cast<size_t>(vectors.element_count() / std::max<int64_t>(vectors.dimensions().back(), 1));
  const char* from = static_cast<const char*>(vectors.untyped_data());
  std::vector<std::pair<char*, size_t>> to(pieces.size());
  for (size_t k = 0; k < to.size(); ++k) {
    auto piece = *pieces.get<ffi::AnyBuffer>(k);
    to[k] = {static_cast<char*>(piece->untyped_data()), num_rows ? piece->size_bytes() / num_rows : 0};
  }
  for (size_t row = 0; row < num_rows; ++row) {
    for (const auto& [begin, size] : to) {
      std::memcpy(begin + row * size, from, size);
      from += size;
    }
  }
  return ffi::Error::Success();
}

}  // namespace

XLA_FFI_DEFINE_HANDLER_SYMBOL(REWAX_SPLIT_HANDLER, Split, ffi::Ffi::Bind().Arg<ffi::AnyBuffer>().RemainingRets());
