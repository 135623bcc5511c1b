#include "av1/warp.h"

#include <algorithm>
#include <bit>
#include <cstdlib>

#include "av1/spec_tables.h"

namespace colmap_av1::av1 {
namespace {

std::int64_t round2_signed(std::int64_t x, int n) {
  if (n == 0) return x;
  const std::int64_t half = std::int64_t{1} << (n - 1);
  return x >= 0 ? (x + half) >> n : -((-x + half) >> n);
}

struct Divisor {
  int shift;
  std::int64_t factor;
};

// 7.11.3.7 Resolve divisor process
Divisor resolve_divisor(std::int64_t d) {
  const std::uint64_t magnitude =
      d < 0 ? 0 - static_cast<std::uint64_t>(d) : static_cast<std::uint64_t>(d);
  const int n = static_cast<int>(std::bit_width(magnitude)) - 1;
  const std::int64_t e = static_cast<std::int64_t>(magnitude - (std::uint64_t{1} << n));
  const std::int64_t f =
      n > DIV_LUT_BITS ? round2_signed(e, n - DIV_LUT_BITS) : e << (DIV_LUT_BITS - n);
  const std::int64_t factor = kDivLut[f];
  return {n + DIV_LUT_PREC_BITS, d < 0 ? -factor : factor};
}

int ls_product(int a, int b) { return ((a * b) >> 2) + (a + b); }

}  // namespace

bool warp_valid(const WarpParams& p) {
  constexpr int kOne = 1 << WARPEDMODEL_PREC_BITS;
  if (p[2] <= 0) return false;
  const auto clip16 = [](std::int64_t v) { return std::clamp<std::int64_t>(v, -32768, 32767); };
  const std::int64_t alpha0 = clip16(p[2] - kOne);
  const std::int64_t beta0 = clip16(p[3]);
  const auto reduce = [](std::int64_t x) {
    return std::abs(round2_signed(x, WARP_PARAM_REDUCE_BITS) * (1 << WARP_PARAM_REDUCE_BITS));
  };
  // This leaves |p[3]| below 2^14, so the products below fit in 64 bits for every p[4].
  if (4 * reduce(alpha0) + 7 * reduce(beta0) >= kOne) return false;
  const Divisor divisor = resolve_divisor(p[2]);
  const std::int64_t v = static_cast<std::int64_t>(p[4]) * kOne;
  const std::int64_t gamma0 = clip16(round2_signed(v * divisor.factor, divisor.shift));
  const std::int64_t w = static_cast<std::int64_t>(p[3]) * p[4];
  const std::int64_t delta0 =
      clip16(p[5] - round2_signed(w * divisor.factor, divisor.shift) - kOne);
  return 4 * reduce(gamma0) + 4 * reduce(delta0) < kOne;
}

LocalWarp estimate_local_warp(const BlockInfo& block, std::span<const WarpSample> samples) {
  const Mv mv = block.mv[0];
  LocalWarp warp;
  std::int64_t a00 = 0, a01 = 0, a11 = 0;
  std::int64_t bx0 = 0, bx1 = 0, by0 = 0, by1 = 0;
  const int mid_y = block.mi_row * 4 + block.bh4() * 2 - 1;
  const int mid_x = block.mi_col * 4 + block.bw4() * 2 - 1;
  const int suy = mid_y * 8;
  const int sux = mid_x * 8;
  const int duy = suy + mv.row;
  const int dux = sux + mv.col;
  for (const WarpSample& sample : samples) {
    const int sy = sample.row - suy;
    const int sx = sample.col - sux;
    const int dy = sample.ref_row - duy;
    const int dx = sample.ref_col - dux;
    if (std::abs(sx - dx) >= LS_MV_MAX || std::abs(sy - dy) >= LS_MV_MAX) continue;
    a00 += ls_product(sx, sx) + 8;
    a01 += ls_product(sx, sy) + 4;
    a11 += ls_product(sy, sy) + 8;
    bx0 += ls_product(sx, dx) + 8;
    bx1 += ls_product(sy, dx) + 4;
    by0 += ls_product(sx, dy) + 4;
    by1 += ls_product(sy, dy) + 8;
  }
  // 64 bits hold every product exactly, also for damaged streams: blocks are at most 128 samples
  // wide and samples come from blocks that touch this one, so |sx|, |sy| <= 1024 in 1/8 sample,
  // |dx|, |dy| < 1024 + LS_MV_MAX, and each of the 8 terms of a sum is below 2^18.4. Sums stay
  // below 2^21.4, determinants and the divided values below 2^43.8; the factor is at most 2^14,
  // or 2^16 if shift is negative.
  const std::int64_t det = a00 * a11 - a01 * a01;
  if (det == 0) return warp;
  Divisor divisor = resolve_divisor(det);
  divisor.shift -= WARPEDMODEL_PREC_BITS;
  if (divisor.shift < 0) {
    divisor.factor *= std::int64_t{1} << -divisor.shift;
    divisor.shift = 0;
  }
  constexpr std::int64_t kOne = 1 << WARPEDMODEL_PREC_BITS;
  constexpr std::int64_t kLimit = WARPEDMODEL_NONDIAGAFFINE_CLAMP - 1;
  const auto divide = [&](std::int64_t v) {
    return round2_signed(v * divisor.factor, divisor.shift);
  };
  const auto nondiag = [&](std::int64_t v) {
    return static_cast<std::int32_t>(std::clamp(divide(v), -kLimit, kLimit));
  };
  const auto diag = [&](std::int64_t v) {
    return static_cast<std::int32_t>(std::clamp(divide(v), kOne - kLimit, kOne + kLimit));
  };
  auto& p = warp.params;
  p[2] = diag(a11 * bx0 - a01 * bx1);
  p[3] = nondiag(-a01 * bx0 + a00 * bx1);
  p[4] = nondiag(a11 * by0 - a01 * by1);
  p[5] = diag(-a01 * by0 + a00 * by1);
  const std::int64_t vx = std::int64_t{mv.col} * (1 << (WARPEDMODEL_PREC_BITS - 3)) -
                          (mid_x * (p[2] - kOne) + std::int64_t{mid_y} * p[3]);
  const std::int64_t vy = std::int64_t{mv.row} * (1 << (WARPEDMODEL_PREC_BITS - 3)) -
                          (std::int64_t{mid_x} * p[4] + mid_y * (p[5] - kOne));
  constexpr std::int64_t kTrans = WARPEDMODEL_TRANS_CLAMP;
  p[0] = static_cast<std::int32_t>(std::clamp(vx, -kTrans, kTrans - 1));
  p[1] = static_cast<std::int32_t>(std::clamp(vy, -kTrans, kTrans - 1));
  warp.valid = warp_valid(p);
  return warp;
}

}  // namespace colmap_av1::av1
