// The set of CDF arrays that frames save and load (specification section 6.8.2,
// init_non_coeff_cdfs and init_coeff_cdfs).
#pragma once

#include <cstdint>
#include <type_traits>

#include "av1/default_cdfs.h"

namespace colmap_av1::av1 {

// X(member, default table): arrays that are copied unchanged
#define COLMAP_AV1_PLAIN_CDFS(X)                             \
  X(intra_frame_y_mode, kDefaultIntraFrameYModeCdf)          \
  X(y_mode, kDefaultYModeCdf)                                \
  X(uv_mode_cfl_not_allowed, kDefaultUvModeCflNotAllowedCdf) \
  X(uv_mode_cfl_allowed, kDefaultUvModeCflAllowedCdf)        \
  X(angle_delta, kDefaultAngleDeltaCdf)                      \
  X(intrabc, kDefaultIntrabcCdf)                             \
  X(partition_w8, kDefaultPartitionW8Cdf)                    \
  X(partition_w16, kDefaultPartitionW16Cdf)                  \
  X(partition_w32, kDefaultPartitionW32Cdf)                  \
  X(partition_w64, kDefaultPartitionW64Cdf)                  \
  X(partition_w128, kDefaultPartitionW128Cdf)                \
  X(segment_id, kDefaultSegmentIdCdf)                        \
  X(segment_id_predicted, kDefaultSegmentIdPredictedCdf)     \
  X(tx_8x8, kDefaultTx8x8Cdf)                                \
  X(tx_16x16, kDefaultTx16x16Cdf)                            \
  X(tx_32x32, kDefaultTx32x32Cdf)                            \
  X(tx_64x64, kDefaultTx64x64Cdf)                            \
  X(txfm_split, kDefaultTxfmSplitCdf)                        \
  X(filter_intra_mode, kDefaultFilterIntraModeCdf)           \
  X(filter_intra, kDefaultFilterIntraCdf)                    \
  X(interp_filter, kDefaultInterpFilterCdf)                  \
  X(motion_mode, kDefaultMotionModeCdf)                      \
  X(new_mv, kDefaultNewMvCdf)                                \
  X(zero_mv, kDefaultZeroMvCdf)                              \
  X(ref_mv, kDefaultRefMvCdf)                                \
  X(compound_mode, kDefaultCompoundModeCdf)                  \
  X(drl_mode, kDefaultDrlModeCdf)                            \
  X(is_inter, kDefaultIsInterCdf)                            \
  X(comp_mode, kDefaultCompModeCdf)                          \
  X(skip_mode, kDefaultSkipModeCdf)                          \
  X(skip, kDefaultSkipCdf)                                   \
  X(comp_ref, kDefaultCompRefCdf)                            \
  X(comp_bwd_ref, kDefaultCompBwdRefCdf)                     \
  X(single_ref, kDefaultSingleRefCdf)                        \
  X(palette_y_mode, kDefaultPaletteYModeCdf)                 \
  X(palette_uv_mode, kDefaultPaletteUvModeCdf)               \
  X(palette_y_size, kDefaultPaletteYSizeCdf)                 \
  X(palette_uv_size, kDefaultPaletteUvSizeCdf)               \
  X(palette_size_2_y_color, kDefaultPaletteSize2YColorCdf)   \
  X(palette_size_3_y_color, kDefaultPaletteSize3YColorCdf)   \
  X(palette_size_4_y_color, kDefaultPaletteSize4YColorCdf)   \
  X(palette_size_5_y_color, kDefaultPaletteSize5YColorCdf)   \
  X(palette_size_6_y_color, kDefaultPaletteSize6YColorCdf)   \
  X(palette_size_7_y_color, kDefaultPaletteSize7YColorCdf)   \
  X(palette_size_8_y_color, kDefaultPaletteSize8YColorCdf)   \
  X(palette_size_2_uv_color, kDefaultPaletteSize2UvColorCdf) \
  X(palette_size_3_uv_color, kDefaultPaletteSize3UvColorCdf) \
  X(palette_size_4_uv_color, kDefaultPaletteSize4UvColorCdf) \
  X(palette_size_5_uv_color, kDefaultPaletteSize5UvColorCdf) \
  X(palette_size_6_uv_color, kDefaultPaletteSize6UvColorCdf) \
  X(palette_size_7_uv_color, kDefaultPaletteSize7UvColorCdf) \
  X(palette_size_8_uv_color, kDefaultPaletteSize8UvColorCdf) \
  X(delta_q, kDefaultDeltaQCdf)                              \
  X(delta_lf, kDefaultDeltaLfCdf)                            \
  X(intra_tx_type_set1, kDefaultIntraTxTypeSet1Cdf)          \
  X(intra_tx_type_set2, kDefaultIntraTxTypeSet2Cdf)          \
  X(inter_tx_type_set1, kDefaultInterTxTypeSet1Cdf)          \
  X(inter_tx_type_set2, kDefaultInterTxTypeSet2Cdf)          \
  X(inter_tx_type_set3, kDefaultInterTxTypeSet3Cdf)          \
  X(use_obmc, kDefaultUseObmcCdf)                            \
  X(inter_intra, kDefaultInterIntraCdf)                      \
  X(comp_ref_type, kDefaultCompRefTypeCdf)                   \
  X(cfl_sign, kDefaultCflSignCdf)                            \
  X(uni_comp_ref, kDefaultUniCompRefCdf)                     \
  X(wedge_inter_intra, kDefaultWedgeInterIntraCdf)           \
  X(comp_group_idx, kDefaultCompGroupIdxCdf)                 \
  X(compound_idx, kDefaultCompoundIdxCdf)                    \
  X(compound_type, kDefaultCompoundTypeCdf)                  \
  X(inter_intra_mode, kDefaultInterIntraModeCdf)             \
  X(wedge_index, kDefaultWedgeIndexCdf)                      \
  X(cfl_alpha, kDefaultCflAlphaCdf)                          \
  X(use_wiener, kDefaultUseWienerCdf)                        \
  X(use_sgrproj, kDefaultUseSgrprojCdf)                      \
  X(restoration_type, kDefaultRestorationTypeCdf)

// X(member, default table): one set per quantizer range in the default table
#define COLMAP_AV1_COEFF_CDFS(X)             \
  X(txb_skip, kDefaultTxbSkipCdf)            \
  X(eob_pt_16, kDefaultEobPt16Cdf)           \
  X(eob_pt_32, kDefaultEobPt32Cdf)           \
  X(eob_pt_64, kDefaultEobPt64Cdf)           \
  X(eob_pt_128, kDefaultEobPt128Cdf)         \
  X(eob_pt_256, kDefaultEobPt256Cdf)         \
  X(eob_pt_512, kDefaultEobPt512Cdf)         \
  X(eob_pt_1024, kDefaultEobPt1024Cdf)       \
  X(eob_extra, kDefaultEobExtraCdf)          \
  X(dc_sign, kDefaultDcSignCdf)              \
  X(coeff_base_eob, kDefaultCoeffBaseEobCdf) \
  X(coeff_base, kDefaultCoeffBaseCdf)        \
  X(coeff_br, kDefaultCoeffBrCdf)

// CDFs of one component of a motion vector difference
struct MvComponentCdfs {
  std::uint16_t sign[3];
  std::uint16_t mv_class[12];
  std::uint16_t class0_bit[3];
  std::uint16_t class0_fr[2][5];
  std::uint16_t class0_hp[3];
  std::uint16_t bits[10][3];
  std::uint16_t fr[5];
  std::uint16_t hp[3];
};

struct MvCdfs {
  std::uint16_t joint[5];
  MvComponentCdfs component[2];
};

// All CDF arrays, stored as 32768 - cdf (see SymbolDecoder); the last entry of each array
// is its adaptation counter.
struct CdfContext {
#define COLMAP_AV1_DECLARE(member, table) std::remove_cvref_t<decltype(table)> member;
  COLMAP_AV1_PLAIN_CDFS(COLMAP_AV1_DECLARE)
#undef COLMAP_AV1_DECLARE
#define COLMAP_AV1_DECLARE(member, table) std::remove_cvref_t<decltype(table[0])> member;
  COLMAP_AV1_COEFF_CDFS(COLMAP_AV1_DECLARE)
#undef COLMAP_AV1_DECLARE
  std::uint16_t delta_lf_multi[4][5];
  MvCdfs mv[2];               // MvCtx: 0, MV_INTRABC_CONTEXT
  std::uint16_t padding[16];  // SymbolDecoder works on whole vectors

  void init_non_coeff_cdfs();
  void init_coeff_cdfs(int base_q_idx);
  // Sets every adaptation counter to 0, as load_cdfs requires.
  void clear_counters();
};

}  // namespace colmap_av1::av1
