#include "av1/units.h"

#include <cstddef>
#include <cstring>

#if defined(__SSE2__) || defined(_M_X64)
#include <emmintrin.h>
#endif

namespace colmap_av1::av1 {
namespace {

void fill_unit(const BlockInfo& block, std::size_t i, Units& u) {
  u.mv[i] = block.mv;
  u.mi_size[i] = block.mi_size;
  u.y_mode[i] = block.y_mode;
  u.is_inter[i] = block.is_inter;
  u.skip[i] = block.skip;
  u.skip_mode[i] = block.skip_mode;
  u.segment_id[i] = block.segment_id;
  u.motion_mode[i] = block.motion_mode;
  u.compound_type[i] = block.compound_type;
  u.interintra[i] = block.interintra;
  u.use_intrabc[i] = block.use_intrabc;
  u.ref_frame[i] = block.ref_frame;
  u.warp_index[i] = block.warp_index;
}

#if defined(__SSE2__) || defined(_M_X64)

constexpr std::size_t kStep = 16;  // units that are filled together

static_assert(sizeof(BlockInfo::mv) == 8 && sizeof(bool) == 1);
static_assert(offsetof(BlockInfo, y_mode) == offsetof(BlockInfo, mi_size) + 1);
static_assert(offsetof(BlockInfo, is_inter) == offsetof(BlockInfo, mi_size) + 2);
static_assert(offsetof(BlockInfo, skip) == offsetof(BlockInfo, mi_size) + 3);
static_assert(offsetof(BlockInfo, skip_mode) == offsetof(BlockInfo, mi_size) + 4);
static_assert(offsetof(BlockInfo, segment_id) == offsetof(BlockInfo, mi_size) + 5);
static_assert(offsetof(BlockInfo, motion_mode) == offsetof(BlockInfo, mi_size) + 6);
static_assert(offsetof(BlockInfo, compound_type) == offsetof(BlockInfo, mi_size) + 7);
static_assert(offsetof(BlockInfo, interintra) == offsetof(BlockInfo, mi_size) + 8);
static_assert(offsetof(BlockInfo, use_intrabc) == offsetof(BlockInfo, mi_size) + 9);
static_assert(offsetof(BlockInfo, ref_frame) == offsetof(BlockInfo, mi_size) + 10);
static_assert(offsetof(BlockInfo, warp_index) == offsetof(BlockInfo, mi_size) + 12);

template <typename T>
void store(UnitVector<T>& units, std::size_t i, __m128i v) {
  _mm_storeu_si128(reinterpret_cast<__m128i*>(units.data() + i), v);
}

// The low and the high bytes of 16 pairs
void split_bytes(__m128i v0, __m128i v1, __m128i& low, __m128i& high) {
  const __m128i mask = _mm_set1_epi16(0xFF);
  low = _mm_packus_epi16(_mm_and_si128(v0, mask), _mm_and_si128(v1, mask));
  high = _mm_packus_epi16(_mm_srli_epi16(v0, 8), _mm_srli_epi16(v1, 8));
}

// The first to fourth bytes of 16 words
void split_words(const __m128i (&v)[4], __m128i (&bytes)[4]) {
  __m128i even[2];
  __m128i odd[2];
  for (int k = 0; k < 2; ++k) split_bytes(v[2 * k], v[2 * k + 1], even[k], odd[k]);
  split_bytes(even[0], even[1], bytes[0], bytes[2]);
  split_bytes(odd[0], odd[1], bytes[1], bytes[3]);
}

// Units from i on: the 16 bytes from BlockInfo::mi_size on are a row of a matrix that is
// transposed.
void fill_step(BlockInfo* const* grid, std::size_t i, Units& u) {
  __m128i words[4][4];  // [word of the row][group of four units]
  for (std::size_t group = 0; group < 4; ++group) {
    __m128i rows[4];
    for (std::size_t k = 0; k < 4; ++k) {
      const BlockInfo* block = grid[i + 4 * group + k];
      std::memcpy(&u.mv[i + 4 * group + k], &block->mv, sizeof block->mv);
      rows[k] = _mm_loadu_si128(reinterpret_cast<const __m128i*>(&block->mi_size));
    }
    const __m128i low01 = _mm_unpacklo_epi32(rows[0], rows[1]);
    const __m128i low23 = _mm_unpacklo_epi32(rows[2], rows[3]);
    const __m128i high01 = _mm_unpackhi_epi32(rows[0], rows[1]);
    const __m128i high23 = _mm_unpackhi_epi32(rows[2], rows[3]);
    words[0][group] = _mm_unpacklo_epi64(low01, low23);
    words[1][group] = _mm_unpackhi_epi64(low01, low23);
    words[2][group] = _mm_unpacklo_epi64(high01, high23);
    words[3][group] = _mm_unpackhi_epi64(high01, high23);
    store(u.warp_index, i + 4 * group, words[3][group]);
  }
  __m128i bytes[4];
  split_words(words[0], bytes);
  store(u.mi_size, i, bytes[0]);
  store(u.y_mode, i, bytes[1]);
  store(u.is_inter, i, bytes[2]);
  store(u.skip, i, bytes[3]);
  split_words(words[1], bytes);
  store(u.skip_mode, i, bytes[0]);
  store(u.segment_id, i, bytes[1]);
  store(u.motion_mode, i, bytes[2]);
  store(u.compound_type, i, bytes[3]);
  split_words(words[2], bytes);
  store(u.interintra, i, bytes[0]);
  store(u.use_intrabc, i, bytes[1]);
  store(u.ref_frame, i, _mm_unpacklo_epi8(bytes[2], bytes[3]));
  store(u.ref_frame, i + 8, _mm_unpackhi_epi8(bytes[2], bytes[3]));
}

#else

constexpr std::size_t kStep = 1;

void fill_step(BlockInfo* const* grid, std::size_t i, Units& u) { fill_unit(*grid[i], i, u); }

#endif

}  // namespace

void fill_units(const std::vector<BlockInfo*>& grid, Units& u) {
  const std::size_t n = grid.size();
  u.mv.resize(n);
  u.ref_frame.resize(n);
  for (auto* field : {&u.mi_size, &u.y_mode, &u.is_inter, &u.skip, &u.skip_mode, &u.segment_id,
                      &u.motion_mode, &u.compound_type, &u.interintra, &u.use_intrabc}) {
    field->resize(n);
  }
  u.warp_index.resize(n);
  std::size_t i = 0;
  for (; i + kStep <= n; i += kStep) fill_step(grid.data(), i, u);
  for (; i < n; ++i) fill_unit(*grid[i], i, u);
}

}  // namespace colmap_av1::av1
