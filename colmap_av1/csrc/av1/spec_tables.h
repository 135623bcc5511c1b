// Generated from the AV1 specification's tables by generate_tables.py. Do not edit.
// clang-format off

#pragma once

#include <cstdint>

namespace colmap_av1::av1 {

extern const std::uint8_t kSegmentationFeatureBits[8];
extern const std::uint8_t kSegmentationFeatureSigned[8];
extern const std::uint8_t kSegmentationFeatureMax[8];
extern const std::uint8_t kRemapLrType[4];
extern const std::int8_t kWienerTapsMid[3];
extern const std::int8_t kSgrprojXqdMid[2];
extern const std::uint8_t kMaxTxDepth[22];
extern const std::uint8_t kSubsampledSize[22][2][2];
extern const std::uint8_t kTxTypeInSetIntra[3][16];
extern const std::uint8_t kTxTypeInSetInter[4][16];
extern const std::uint8_t kTxTypeIntraInvSet1[7];
extern const std::uint8_t kTxTypeIntraInvSet2[5];
extern const std::uint8_t kTxTypeInterInvSet1[16];
extern const std::uint8_t kTxTypeInterInvSet2[12];
extern const std::uint8_t kTxTypeInterInvSet3[2];
extern const std::int8_t kWienerTapsMin[3];
extern const std::uint8_t kWienerTapsMax[3];
extern const std::uint8_t kWienerTapsK[3];
extern const std::int8_t kSgrprojXqdMin[2];
extern const std::uint8_t kSgrprojXqdMax[2];
extern const std::uint8_t kRefFrameList[5];
extern const std::uint16_t kDivMult[32];
extern const std::uint16_t kDivLut[257];
extern const std::uint8_t kQuantDistWeight[4][2];
extern const std::uint8_t kQuantDistLookup[4][2];
extern const std::uint8_t kSgrParams[16][4];
extern const std::uint8_t kIntraModeContext[13];
extern const std::uint8_t kCompoundModeCtxMap[3][5];
extern const std::uint8_t kCoeffBaseCtxOffset[19][5][5];
extern const std::uint8_t kCoeffBasePosCtxOffset[3];
extern const std::uint8_t kMagRefOffsetWithTxClass[3][3][2];
extern const std::uint8_t kFilterIntraModeToIntraDir[5];
extern const std::uint8_t kDefaultScan4x4[16];
extern const std::uint8_t kMcolScan4x4[16];
extern const std::uint8_t kMrowScan4x4[16];
extern const std::uint8_t kDefaultScan4x8[32];
extern const std::uint8_t kMcolScan4x8[32];
extern const std::uint8_t kMrowScan4x8[32];
extern const std::uint8_t kDefaultScan8x4[32];
extern const std::uint8_t kMcolScan8x4[32];
extern const std::uint8_t kMrowScan8x4[32];
extern const std::uint8_t kDefaultScan8x8[64];
extern const std::uint8_t kMcolScan8x8[64];
extern const std::uint8_t kMrowScan8x8[64];
extern const std::uint8_t kDefaultScan8x16[128];
extern const std::uint8_t kMcolScan8x16[128];
extern const std::uint8_t kMrowScan8x16[128];
extern const std::uint8_t kDefaultScan16x8[128];
extern const std::uint8_t kMcolScan16x8[128];
extern const std::uint8_t kMrowScan16x8[128];
extern const std::uint8_t kDefaultScan16x16[256];
extern const std::uint8_t kMcolScan16x16[256];
extern const std::uint8_t kMrowScan16x16[256];
extern const std::uint16_t kDefaultScan16x32[512];
extern const std::uint16_t kDefaultScan32x16[512];
extern const std::uint16_t kDefaultScan32x32[1024];
extern const std::uint8_t kDefaultScan4x16[64];
extern const std::uint8_t kMcolScan4x16[64];
extern const std::uint8_t kMrowScan4x16[64];
extern const std::uint8_t kDefaultScan16x4[64];
extern const std::uint8_t kMcolScan16x4[64];
extern const std::uint8_t kMrowScan16x4[64];
extern const std::uint8_t kDefaultScan8x32[256];
extern const std::uint8_t kDefaultScan32x8[256];
extern const std::uint8_t kMiWidthLog2[22];
extern const std::uint8_t kMiHeightLog2[22];
extern const std::uint8_t kNum4x4BlocksWide[22];
extern const std::uint8_t kNum4x4BlocksHigh[22];
extern const std::uint8_t kSizeGroup[22];
extern const std::uint8_t kMaxTxSizeRect[22];
extern const std::uint8_t kPartitionSubsize[10][22];
extern const std::uint8_t kSplitTxSize[19];
extern const std::uint8_t kModeToTxfm[14];
extern const std::int8_t kPaletteColorContext[9];
extern const std::uint8_t kPaletteColorHashMultipliers[3];
extern const std::uint8_t kTxSizeSqr[19];
extern const std::uint8_t kTxSizeSqrUp[19];
extern const std::uint8_t kTxWidth[19];
extern const std::uint8_t kTxHeight[19];
extern const std::uint8_t kTxWidthLog2[19];
extern const std::uint8_t kTxHeightLog2[19];
extern const std::uint8_t kWedgeBits[22];
extern const std::uint8_t kSigRefDiffOffset[3][5][2];
extern const std::uint8_t kAdjustedTxSize[19];
extern const std::uint8_t kBlockWidth[22];
extern const std::uint8_t kBlockHeight[22];

}  // namespace colmap_av1::av1
