// Vectors of numbers and functions on them, for the machine's instructions (instructions.py).

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>

namespace {

#if defined(__AVX512F__)
constexpr int kBytes = 64;
#elif defined(__AVX__)
constexpr int kBytes = 32;
#else
constexpr int kBytes = 16;
#endif

constexpr int kLanes = kBytes / static_cast<int>(sizeof(T));
constexpr T kInfinity = static_cast<T>(__builtin_inf()), kNaN = static_cast<T>(__builtin_nan(""));

typedef T V __attribute__((vector_size(kBytes)));      // several elements
typedef T U __attribute__((vector_size(sizeof(T))));   // one number for all of them
typedef decltype(V{} < V{}) VI;                        // integers and booleans (0, -1) of the same width
typedef decltype(U{} < U{}) UI;

template <typename X>
constexpr int kSize = static_cast<int>(sizeof(X) / sizeof(T));

#define REWAX_LANES(X, expression)                \
  X r;                                            \
  for (int l = 0; l < kSize<X>; ++l) r[l] = (expression); \
  return r

inline V Wide(U a) { return a[0] - V{}; }
inline VI Wide(UI a) { return a[0] + VI{}; }

template <typename X>
X Full(T a) {  // copies the bits, which may be those of an integer
  REWAX_LANES(X, a);
}

// NaN if either operand is NaN.
template <typename X>
X Max(X a, X b) {
  return ((a > b) | (a != a)) ? a : b;
}
template <typename X>
X Min(X a, X b) {
  return ((a < b) | (a != a)) ? a : b;
}
#define REWAX_UNARY(name, function)            \
  template <typename X>                        \
  X name(X a) {                                \
    REWAX_LANES(X, function(a[l]));            \
  }
REWAX_UNARY(Abs, std::fabs)
REWAX_UNARY(Sqrt, std::sqrt)
REWAX_UNARY(Floor, std::floor)
REWAX_UNARY(Ceil, std::ceil)
REWAX_UNARY(RoundEven, std::nearbyint)
REWAX_UNARY(RoundAway, std::round)
REWAX_UNARY(Exp2, std::exp2)
REWAX_UNARY(Tan, std::tan)
REWAX_UNARY(Asin, std::asin)
REWAX_UNARY(Acos, std::acos)
REWAX_UNARY(Atan, std::atan)
REWAX_UNARY(Sinh, std::sinh)
REWAX_UNARY(Cosh, std::cosh)
REWAX_UNARY(Tanh, std::tanh)
REWAX_UNARY(Asinh, std::asinh)
REWAX_UNARY(Acosh, std::acosh)
REWAX_UNARY(Atanh, std::atanh)
REWAX_UNARY(Erf, std::erf)
REWAX_UNARY(Erfc, std::erfc)
REWAX_UNARY(Cbrt, std::cbrt)
REWAX_UNARY(Log1p, std::log1p)
REWAX_UNARY(Expm1, std::expm1)

template <typename X>
X Sign(X a) {
  return a > 0 ? X{} + 1 : a < 0 ? X{} - 1 : a;
}
// Sign-extends the low 32 bits in lanes of 64 bits.
template <typename X>
X Wrap(X a) {
  if constexpr (sizeof(T) == 8) return (a << 32) >> 32;
  return a;
}
// Integer division as in XLA: division by zero gives quotient -1 and remainder the dividend; nothing overflows.
template <typename X>
X Div(X a, X b) {
  if constexpr (std::is_floating_point_v<std::decay_t<decltype(X{}[0])>>) {
    return a / b;
  } else {
    REWAX_LANES(X, b[l] == 0 ? -1 : b[l] == -1 ? (X{} - a)[l] : a[l] / b[l]);
  }
}
template <typename X>
X Rem(X a, X b) {
  if constexpr (std::is_floating_point_v<std::decay_t<decltype(X{}[0])>>) {
    REWAX_LANES(X, std::fmod(a[l], b[l]));
  } else {
    REWAX_LANES(X, b[l] == 0 ? a[l] : b[l] == -1 ? 0 : a[l] % b[l]);
  }
}
template <typename X>
X Pow(X a, X b) {
  REWAX_LANES(X, std::pow(a[l], b[l]));
}
template <typename X>
auto IsFinite(X a) {
  return Abs(a) < Full<X>(kInfinity);
}

// Exponential, logarithm, sine and cosine of all lanes at once, with the reductions and polynomials of Moshier's Cephes
// library. Double precision, which only tests use, calls the C library.
template <typename X>
X Exp(X a) {
  if constexpr (sizeof(T) == 8) {
    REWAX_LANES(X, std::exp(a[l]));
  } else {
    typedef decltype(X{} < X{}) I;
    const X x = Min(Max(a, Full<X>(-104.0f)), Full<X>(89.0f));
    const X n = Floor(x * 1.44269504088896341f + 0.5f);
    const X r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
    X p = Full<X>(1.9875691500e-4f);
    p = p * r + 1.3981999507e-3f;
    p = p * r + 8.3334519073e-3f;
    p = p * r + 4.1665795894e-2f;
    p = p * r + 1.6666665459e-1f;
    p = p * r + 5.0000001201e-1f;
    p = p * (r * r) + r + 1.0f;
    // 2^n in two factors: n = 128 and n < -126 exceed the range of a float's exponent.
    const I integer = __builtin_convertvector(n == n ? n : X{}, I), half = integer >> 1;
    const I first = (half + 127) << 23, second = (integer - half + 127) << 23;
    return p * (X)first * (X)second;
  }
}
template <typename X>
X Log(X a) {
  if constexpr (sizeof(T) == 8) {
    REWAX_LANES(X, std::log(a[l]));
  } else {
    typedef decltype(X{} < X{}) I;
    const auto small = a < 1.17549435e-38f;
    const X x = small ? a * 8388608.0f : a;
    const I bits = (I)x;
    I e = ((bits >> 23) & 255) - 126;
    X m = (X)((bits & 0x007fffff) | 0x3f000000);  // in [1/2, 1)
    const auto low = m < 0.707106781186547524f;
    e = e + low;
    m = (low ? m + m : m) - 1.0f;
    const X n = __builtin_convertvector(e, X) - (small ? Full<X>(23.0f) : X{});
    const X z = m * m;
    X p = Full<X>(7.0376836292e-2f);
    p = p * m - 1.1514610310e-1f;
    p = p * m + 1.1676998740e-1f;
    p = p * m - 1.2420140846e-1f;
    p = p * m + 1.4249322787e-1f;
    p = p * m - 1.6668057665e-1f;
    p = p * m + 2.0000714765e-1f;
    p = p * m - 2.4999993993e-1f;
    p = p * m + 3.3333331174e-1f;
    p = p * m * z - n * 2.12194440e-4f - 0.5f * z;
    const X y = m + p + n * 0.693359375f;
    const X special = a == 0.0f ? Full<X>(-kInfinity) : a < 0.0f ? Full<X>(kNaN) : a;
    return (a > 0.0f) & (a < kInfinity) ? y : special;
  }
}

template <typename X>
X SineOrCosine(X a, int quarters) {
  const auto precise = [quarters](T angle) { return quarters ? std::cos(angle) : std::sin(angle); };
  if constexpr (sizeof(T) == 8) {
    REWAX_LANES(X, precise(a[l]));
  }
  typedef decltype(X{} < X{}) I;
  const X n = Floor(a * T(0.636619772367581343) + T(0.5));
  const X r = ((a - n * T(1.5703125)) - n * T(4.83751296997070312e-4)) - n * T(7.54978995489188216e-8);
  const X z = r * r;
  const X sine = ((T(-1.9515295891e-4) * z + T(8.3321608736e-3)) * z - T(1.6666654611e-1)) * z * r + r;
  const X cosine =
      ((T(2.443315711809948e-5) * z - T(1.388731625493765e-3)) * z + T(4.166664568298827e-2)) * z * z - T(0.5) * z + T(1);
  const I turn = __builtin_convertvector(n == n ? n : X{}, I) + quarters;
  X value = (turn & 1) != 0 ? cosine : sine;
  value = (turn & 2) != 0 ? -value : value;
  // The polynomials are wrong for larger angles. Lane by lane: a lane's result must not depend on other lanes.
  bool small = true;
  for (int l = 0; l < kSize<X>; ++l) small &= !(std::fabs(a[l]) > 8192);
  if (!small) {
    for (int l = 0; l < kSize<X>; ++l) value[l] = std::fabs(a[l]) > 8192 ? precise(a[l]) : value[l];
  }
  return value;
}
// Arc tangent of a / b in the quadrant of the point (b, a), with the polynomial of Cephes for |t| < tan(pi / 8).
template <typename X>
X Atan2(X a, X b) {
  if constexpr (sizeof(T) == 8) {
    REWAX_LANES(X, std::atan2(a[l], b[l]));
  } else {
    typedef decltype(X{} < X{}) I;
    const I sign = I{} + static_cast<int32_t>(0x80000000);
    const X p = (X)((I)a & ~sign), q = (X)((I)b & ~sign);  // absolute values
    X low = p < q ? p : q, high = p < q ? q : p;
    const auto large = high > 1e38f;  // sums must not overflow
    low = large ? low * 0.25f : low;
    high = large ? high * 0.25f : high;
    const auto steep = (low > 0.4142135623730950f * high) | (low == Full<X>(kInfinity));
    const X top = steep ? low - high : low, bottom = steep ? low + high : high;
    const X t = (low == high) | (low == 0.0f) ? X{} : top / bottom;
    const X z = t * t;
    X y = Full<X>(8.05374449538e-2f);
    y = y * z - 1.38776856032e-1f;
    y = y * z + 1.99777106478e-1f;
    y = y * z - 3.33329491539e-1f;
    y = y * z * t + t;
    y = (low == high) & (low == 0.0f) ? X{} : steep ? y + 0.785398163397448310f : y;
    y = p > q ? 1.57079632679489662f - y : y;
    y = ((I)b & sign) != 0 ? 3.14159265358979324f - y : y;
    y = (X)((I)y | ((I)a & sign));
    return (a != a) | (b != b) ? a + b : y;
  }
}
template <typename X>
X Sin(X a) {
  return SineOrCosine(a, 0);
}
template <typename X>
X Cos(X a) {
  return SineOrCosine(a, 1);
}

// Rounds towards zero to an integer of `bits` bits; clamps values out of range; NaN gives 0.
template <typename X>
auto ToInteger(X a, int bits) {
  typedef decltype(X{} < X{}) I;
  const bool wide = bits == 64 && sizeof(T) == 8;
  const X limit = Full<X>(wide ? T(9223372036854775808.0) : T(2147483648.0));
  // Greatest number of type T below the limit.
  const T below = wide ? T(9223372036854774784.0) : sizeof(T) == 8 ? T(2147483647.0) : T(2147483520.0);
  const X inside = Max(Min(a == a ? a : X{}, Full<X>(below)), -limit);
  const I most = I{} + (wide ? static_cast<int64_t>(9223372036854775807LL) : 2147483647);
  return a >= limit ? most : __builtin_convertvector(inside, I);
}

template <typename S>
VI LoadIntegers(const S* from, int count) {
  VI r;
  for (int l = 0; l < kLanes; ++l) r[l] = static_cast<decltype(+r[0])>(from[l < count ? l : count - 1]);
  return r;
}
inline VI LoadBooleans(const bool* from, int count) { return -LoadIntegers(from, count); }
inline void StoreBooleans(bool* to, VI a, int count) {
  for (int l = 0; l < count; ++l) to[l] = a[l] != 0;
}

// Zeros the lanes beyond the last element, before a sum.
inline V Part(V a, int count) {
  if (count < kLanes) {
    for (int l = count; l < kLanes; ++l) a[l] = 0;
  }
  return a;
}
inline T Total(V a) {
  T sum = 0;
  for (int l = 0; l < kLanes; ++l) sum += a[l];
  return sum;
}

}  // namespace
