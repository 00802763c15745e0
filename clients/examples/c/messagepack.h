/* MessagePack, as far as proto/README.md needs it: written into a growing buffer, read as a tree. */
#ifndef FACTORBUS_MESSAGEPACK_H
#define FACTORBUS_MESSAGEPACK_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* ---- writing: every function appends; `failed` says that memory ran out, and nothing after that counts ---- */

typedef struct {
    uint8_t *bytes;
    size_t size, room;
    bool failed;
} mp_buffer;

void mp_free(mp_buffer *out);
void mp_raw(mp_buffer *out, const void *bytes, size_t size);
void mp_nil(mp_buffer *out);
void mp_bool(mp_buffer *out, bool value);
void mp_int(mp_buffer *out, int64_t value);
void mp_uint(mp_buffer *out, uint64_t value);
void mp_float(mp_buffer *out, double value);
void mp_str(mp_buffer *out, const char *text);
void mp_bin(mp_buffer *out, const void *bytes, size_t size);
void mp_array(mp_buffer *out, uint32_t count);
void mp_map(mp_buffer *out, uint32_t count);

/* Columns, §2: little-endian whatever this machine is. */
void mp_i64s(mp_buffer *out, const int64_t *numbers, size_t count);
void mp_f64s(mp_buffer *out, const double *numbers, size_t count);

/* ---- reading ---- */

typedef enum { MP_NIL, MP_BOOL, MP_INT, MP_UINT, MP_FLOAT, MP_STR, MP_BIN, MP_ARRAY, MP_MAP } mp_type;

/* A value. Of a map the children are key, value, key, value …: `count` is twice its fields. Text and bytes are in the
 * message that was read, which has to stay. MP_UINT: 2^63 and above. */
typedef struct mp_value {
    mp_type type;
    bool boolean;
    int64_t integer;
    uint64_t unsigned_integer;
    double number;
    const uint8_t *bytes;
    size_t size;
    struct mp_value *children;
    uint32_t count;
} mp_value;

/* One message and nothing more. NULL if it is not that, or nested deeper than 100, or memory ran out. */
mp_value *mp_read(const uint8_t *bytes, size_t size);
void mp_release(mp_value *value);

/* A field of a map; NULL where there is none. */
const mp_value *mp_field(const mp_value *map, const char *name);
bool mp_is(const mp_value *value, const char *text);

/* The numbers of a column; one of them, from a bin of the right length. */
int64_t mp_i64_at(const mp_value *bin, size_t index);
double mp_f64_at(const mp_value *bin, size_t index);

/* The same bytes again: nothing is lost in between. */
void mp_write(mp_buffer *out, const mp_value *value);

#endif
