// Subexponential codes with a reference value (specification sections 5.9.26 to 5.9.29 in headers,
// 5.11.58 in tiles).
#pragma once

namespace colmap_av1::av1 {

inline int inverse_recenter(int center, int v) {
  if (v > 2 * center) return v;
  return v & 1 ? center - ((v + 1) >> 1) : center + (v >> 1);
}

// `Reader` is BitReader or SymbolDecoder.
template <typename Reader>
int decode_subexp(Reader& reader, int num_syms, int k) {
  int mk = 0;
  for (int i = 0;; ++i) {
    const int b2 = i ? k + i - 1 : k;
    const int a = 1 << b2;
    if (num_syms <= mk + 3 * a) return reader.ns(num_syms - mk) + mk;
    if (!reader.bit()) return reader.literal(b2) + mk;
    mk += a;
  }
}

template <typename Reader>
int decode_signed_subexp_with_ref(Reader& reader, int low, int high, int k, int reference) {
  const int mx = high - low;
  const int r = reference - low;
  const int v = decode_subexp(reader, mx, k);
  const int x = (r << 1) <= mx ? inverse_recenter(r, v) : mx - 1 - inverse_recenter(mx - 1 - r, v);
  return x + low;
}

}  // namespace colmap_av1::av1
