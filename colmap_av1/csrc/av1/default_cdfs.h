// Generated from the AV1 specification's tables by generate_tables.py. Do not edit.
// clang-format off

#pragma once

#include <cstdint>

namespace colmap_av1::av1 {

extern const std::uint16_t kDefaultIntraFrameYModeCdf[5][5][14];
extern const std::uint16_t kDefaultYModeCdf[4][14];
extern const std::uint16_t kDefaultUvModeCflNotAllowedCdf[13][14];
extern const std::uint16_t kDefaultUvModeCflAllowedCdf[13][15];
extern const std::uint16_t kDefaultAngleDeltaCdf[8][8];
extern const std::uint16_t kDefaultIntrabcCdf[3];
extern const std::uint16_t kDefaultPartitionW8Cdf[4][5];
extern const std::uint16_t kDefaultPartitionW16Cdf[4][11];
extern const std::uint16_t kDefaultPartitionW32Cdf[4][11];
extern const std::uint16_t kDefaultPartitionW64Cdf[4][11];
extern const std::uint16_t kDefaultPartitionW128Cdf[4][9];
extern const std::uint16_t kDefaultTx8x8Cdf[3][3];
extern const std::uint16_t kDefaultTx16x16Cdf[3][4];
extern const std::uint16_t kDefaultTx32x32Cdf[3][4];
extern const std::uint16_t kDefaultTx64x64Cdf[3][4];
extern const std::uint16_t kDefaultTxfmSplitCdf[21][3];
extern const std::uint16_t kDefaultFilterIntraModeCdf[6];
extern const std::uint16_t kDefaultFilterIntraCdf[22][3];
extern const std::uint16_t kDefaultSegmentIdCdf[3][9];
extern const std::uint16_t kDefaultSegmentIdPredictedCdf[3][3];
extern const std::uint16_t kDefaultMvClass0HpCdf[3];
extern const std::uint16_t kDefaultMvHpCdf[3];
extern const std::uint16_t kDefaultMvSignCdf[3];
extern const std::uint16_t kDefaultMvBitCdf[10][3];
extern const std::uint16_t kDefaultMvClass0BitCdf[3];
extern const std::uint16_t kDefaultNewMvCdf[6][3];
extern const std::uint16_t kDefaultZeroMvCdf[2][3];
extern const std::uint16_t kDefaultRefMvCdf[6][3];
extern const std::uint16_t kDefaultDrlModeCdf[3][3];
extern const std::uint16_t kDefaultIsInterCdf[4][3];
extern const std::uint16_t kDefaultCompModeCdf[5][3];
extern const std::uint16_t kDefaultSkipModeCdf[3][3];
extern const std::uint16_t kDefaultSkipCdf[3][3];
extern const std::uint16_t kDefaultCompRefCdf[3][3][3];
extern const std::uint16_t kDefaultCompBwdRefCdf[3][2][3];
extern const std::uint16_t kDefaultSingleRefCdf[3][6][3];
extern const std::uint16_t kDefaultCompoundModeCdf[8][9];
extern const std::uint16_t kDefaultInterpFilterCdf[16][4];
extern const std::uint16_t kDefaultMotionModeCdf[22][4];
extern const std::uint16_t kDefaultMvJointCdf[5];
extern const std::uint16_t kDefaultMvClassCdf[2][12];
extern const std::uint16_t kDefaultMvClass0FrCdf[2][2][5];
extern const std::uint16_t kDefaultMvFrCdf[2][5];
extern const std::uint16_t kDefaultPaletteYSizeCdf[7][8];
extern const std::uint16_t kDefaultPaletteUvSizeCdf[7][8];
extern const std::uint16_t kDefaultPaletteSize2YColorCdf[5][3];
extern const std::uint16_t kDefaultPaletteSize3YColorCdf[5][4];
extern const std::uint16_t kDefaultPaletteSize4YColorCdf[5][5];
extern const std::uint16_t kDefaultPaletteSize5YColorCdf[5][6];
extern const std::uint16_t kDefaultPaletteSize6YColorCdf[5][7];
extern const std::uint16_t kDefaultPaletteSize7YColorCdf[5][8];
extern const std::uint16_t kDefaultPaletteSize8YColorCdf[5][9];
extern const std::uint16_t kDefaultPaletteSize2UvColorCdf[5][3];
extern const std::uint16_t kDefaultPaletteSize3UvColorCdf[5][4];
extern const std::uint16_t kDefaultPaletteSize4UvColorCdf[5][5];
extern const std::uint16_t kDefaultPaletteSize5UvColorCdf[5][6];
extern const std::uint16_t kDefaultPaletteSize6UvColorCdf[5][7];
extern const std::uint16_t kDefaultPaletteSize7UvColorCdf[5][8];
extern const std::uint16_t kDefaultPaletteSize8UvColorCdf[5][9];
extern const std::uint16_t kDefaultPaletteYModeCdf[7][3][3];
extern const std::uint16_t kDefaultPaletteUvModeCdf[2][3];
extern const std::uint16_t kDefaultDeltaQCdf[5];
extern const std::uint16_t kDefaultDeltaLfCdf[5];
extern const std::uint16_t kDefaultIntraTxTypeSet1Cdf[2][13][8];
extern const std::uint16_t kDefaultIntraTxTypeSet2Cdf[3][13][6];
extern const std::uint16_t kDefaultInterTxTypeSet1Cdf[2][17];
extern const std::uint16_t kDefaultInterTxTypeSet2Cdf[13];
extern const std::uint16_t kDefaultInterTxTypeSet3Cdf[4][3];
extern const std::uint16_t kDefaultCompoundIdxCdf[6][3];
extern const std::uint16_t kDefaultCompGroupIdxCdf[6][3];
extern const std::uint16_t kDefaultCompoundTypeCdf[22][3];
extern const std::uint16_t kDefaultInterIntraCdf[3][3];
extern const std::uint16_t kDefaultInterIntraModeCdf[3][5];
extern const std::uint16_t kDefaultWedgeIndexCdf[22][17];
extern const std::uint16_t kDefaultWedgeInterIntraCdf[22][3];
extern const std::uint16_t kDefaultUseObmcCdf[22][3];
extern const std::uint16_t kDefaultCompRefTypeCdf[5][3];
extern const std::uint16_t kDefaultUniCompRefCdf[3][3][3];
extern const std::uint16_t kDefaultCflSignCdf[9];
extern const std::uint16_t kDefaultCflAlphaCdf[6][17];
extern const std::uint16_t kDefaultUseWienerCdf[3];
extern const std::uint16_t kDefaultUseSgrprojCdf[3];
extern const std::uint16_t kDefaultRestorationTypeCdf[4];
extern const std::uint16_t kDefaultTxbSkipCdf[4][5][13][3];
extern const std::uint16_t kDefaultEobPt16Cdf[4][2][2][6];
extern const std::uint16_t kDefaultEobPt32Cdf[4][2][2][7];
extern const std::uint16_t kDefaultEobPt64Cdf[4][2][2][8];
extern const std::uint16_t kDefaultEobPt128Cdf[4][2][2][9];
extern const std::uint16_t kDefaultEobPt256Cdf[4][2][2][10];
extern const std::uint16_t kDefaultEobPt512Cdf[4][2][11];
extern const std::uint16_t kDefaultEobPt1024Cdf[4][2][12];
extern const std::uint16_t kDefaultEobExtraCdf[4][5][2][9][3];
extern const std::uint16_t kDefaultDcSignCdf[4][2][3][3];
extern const std::uint16_t kDefaultCoeffBaseEobCdf[4][5][2][4][4];
extern const std::uint16_t kDefaultCoeffBaseCdf[4][5][2][42][5];
extern const std::uint16_t kDefaultCoeffBrCdf[4][5][2][21][5];

}  // namespace colmap_av1::av1
