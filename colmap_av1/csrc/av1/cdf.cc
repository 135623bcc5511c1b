#include "av1/cdf.h"

#include <cstddef>

namespace colmap_av1::av1 {
namespace {

template <std::size_t N>
void load(std::uint16_t (&to)[N], const std::uint16_t (&from)[N]) {
  for (std::size_t i = 0; i + 1 < N; ++i) to[i] = static_cast<std::uint16_t>(32768 - from[i]);
  to[N - 1] = 0;
}

template <typename T, std::size_t N>
void load(T (&to)[N], const T (&from)[N]) {
  for (std::size_t i = 0; i < N; ++i) load(to[i], from[i]);
}

template <std::size_t N>
void clear(std::uint16_t (&cdf)[N]) {
  cdf[N - 1] = 0;
}

template <typename T, std::size_t N>
void clear(T (&cdfs)[N]) {
  for (auto& cdf : cdfs) clear(cdf);
}

}  // namespace

void CdfContext::init_non_coeff_cdfs() {
#define COLMAP_AV1_LOAD(member, table) load(member, table);
  COLMAP_AV1_PLAIN_CDFS(COLMAP_AV1_LOAD)
#undef COLMAP_AV1_LOAD
  for (auto& cdf : delta_lf_multi) load(cdf, kDefaultDeltaLfCdf);
  for (auto& context : mv) {
    load(context.joint, kDefaultMvJointCdf);
    for (int comp = 0; comp < 2; ++comp) {
      MvComponentCdfs& c = context.component[comp];
      load(c.sign, kDefaultMvSignCdf);
      load(c.mv_class, kDefaultMvClassCdf[comp]);
      load(c.class0_bit, kDefaultMvClass0BitCdf);
      load(c.class0_fr, kDefaultMvClass0FrCdf[comp]);
      load(c.class0_hp, kDefaultMvClass0HpCdf);
      load(c.bits, kDefaultMvBitCdf);
      load(c.fr, kDefaultMvFrCdf[comp]);
      load(c.hp, kDefaultMvHpCdf);
    }
  }
}

void CdfContext::init_coeff_cdfs(int base_q_idx) {
  const int idx = base_q_idx <= 20 ? 0 : base_q_idx <= 60 ? 1 : base_q_idx <= 120 ? 2 : 3;
#define COLMAP_AV1_LOAD(member, table) load(member, table[idx]);
  COLMAP_AV1_COEFF_CDFS(COLMAP_AV1_LOAD)
#undef COLMAP_AV1_LOAD
}

void CdfContext::clear_counters() {
#define COLMAP_AV1_CLEAR(member, table) clear(member);
  COLMAP_AV1_PLAIN_CDFS(COLMAP_AV1_CLEAR)
  COLMAP_AV1_COEFF_CDFS(COLMAP_AV1_CLEAR)
#undef COLMAP_AV1_CLEAR
  clear(delta_lf_multi);
  for (auto& context : mv) {
    clear(context.joint);
    for (auto& c : context.component) {
      clear(c.sign);
      clear(c.mv_class);
      clear(c.class0_bit);
      clear(c.class0_fr);
      clear(c.class0_hp);
      clear(c.bits);
      clear(c.fr);
      clear(c.hp);
    }
  }
}

}  // namespace colmap_av1::av1
