#include "messagepack.h"

#include <stdlib.h>
#include <string.h>

enum { DEEPEST = 100 };

/* ---- writing ---- */

void mp_free(mp_buffer *out)
{
    free(out->bytes);
    memset(out, 0, sizeof *out);
}

void mp_raw(mp_buffer *out, const void *bytes, size_t size)
{
    if (out->failed || size == 0) return;
    if (out->room - out->size < size) {
        size_t room = (out->size + size) * 2;
        uint8_t *more = realloc(out->bytes, room);
        if (more == NULL) {
            out->failed = true;
            return;
        }
        out->bytes = more;
        out->room = room;
    }
    memcpy(out->bytes + out->size, bytes, size);
    out->size += size;
}

/* A first byte, and behind it `width` bytes of a number, big-endian. */
static void head(mp_buffer *out, uint8_t first, uint64_t number, int width)
{
    uint8_t bytes[9] = {first};
    for (int i = 0; i < width; i++) bytes[1 + i] = (uint8_t)(number >> (8 * (width - 1 - i)));
    mp_raw(out, bytes, 1 + (size_t)width);
}

/* The shortest form for a count: within the first byte if it is below `room`, else behind one of three codes. */
static void sized(mp_buffer *out, uint8_t fixed, size_t room, uint8_t one, uint8_t two, uint8_t four, size_t count)
{
    if (count < room) head(out, (uint8_t)(fixed | count), 0, 0);
    else if (one != 0 && count < 0x100) head(out, one, count, 1);
    else if (count < 0x10000) head(out, two, count, 2);
    else head(out, four, count, 4);
}

void mp_nil(mp_buffer *out) { head(out, 0xc0, 0, 0); }
void mp_bool(mp_buffer *out, bool value) { head(out, value ? 0xc3 : 0xc2, 0, 0); }

void mp_uint(mp_buffer *out, uint64_t value)
{
    if (value < 0x80) head(out, (uint8_t)value, 0, 0);
    else if (value < 0x100) head(out, 0xcc, value, 1);
    else if (value < 0x10000) head(out, 0xcd, value, 2);
    else if (value < 0x100000000) head(out, 0xce, value, 4);
    else head(out, 0xcf, value, 8);
}

void mp_int(mp_buffer *out, int64_t value)
{
    if (value >= 0) mp_uint(out, (uint64_t)value);
    else if (value >= -0x20) head(out, (uint8_t)value, 0, 0);
    else if (value >= INT8_MIN) head(out, 0xd0, (uint64_t)value, 1);
    else if (value >= INT16_MIN) head(out, 0xd1, (uint64_t)value, 2);
    else if (value >= INT32_MIN) head(out, 0xd2, (uint64_t)value, 4);
    else head(out, 0xd3, (uint64_t)value, 8);
}

static uint64_t bits_of(double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

static void text(mp_buffer *out, const void *bytes, size_t size)
{
    sized(out, 0xa0, 32, 0xd9, 0xda, 0xdb, size);
    mp_raw(out, bytes, size);
}

void mp_float(mp_buffer *out, double value) { head(out, 0xcb, bits_of(value), 8); }
void mp_str(mp_buffer *out, const char *string) { text(out, string, strlen(string)); }
void mp_array(mp_buffer *out, uint32_t count) { sized(out, 0x90, 16, 0, 0xdc, 0xdd, count); }
void mp_map(mp_buffer *out, uint32_t count) { sized(out, 0x80, 16, 0, 0xde, 0xdf, count); }

void mp_bin(mp_buffer *out, const void *bytes, size_t size)
{
    sized(out, 0, 0, 0xc4, 0xc5, 0xc6, size);
    mp_raw(out, bytes, size);
}

static void little(mp_buffer *out, uint64_t bits)
{
    uint8_t bytes[8];
    for (int i = 0; i < 8; i++) bytes[i] = (uint8_t)(bits >> (8 * i));
    mp_raw(out, bytes, 8);
}

void mp_i64s(mp_buffer *out, const int64_t *numbers, size_t count)
{
    sized(out, 0, 0, 0xc4, 0xc5, 0xc6, 8 * count);
    for (size_t i = 0; i < count; i++) little(out, (uint64_t)numbers[i]);
}

void mp_f64s(mp_buffer *out, const double *numbers, size_t count)
{
    sized(out, 0, 0, 0xc4, 0xc5, 0xc6, 8 * count);
    for (size_t i = 0; i < count; i++) little(out, bits_of(numbers[i]));
}

/* ---- reading ---- */

typedef struct {
    const uint8_t *at, *end;
} cursor;

static bool number(cursor *in, int width, uint64_t *value)
{
    if (in->end - in->at < width) return false;
    *value = 0;
    for (int i = 0; i < width; i++) *value = *value << 8 | *in->at++;
    return true;
}

static int64_t extended(uint64_t value, int width)
{
    uint64_t sign = (uint64_t)1 << (8 * width - 1);
    return (int64_t)((value ^ sign) - sign);
}

static bool read_bytes(cursor *in, mp_value *into, mp_type type, uint64_t size)
{
    if ((uint64_t)(in->end - in->at) < size) return false;
    into->type = type;
    into->bytes = in->at;
    into->size = (size_t)size;
    in->at += size;
    return true;
}

static bool read_value(cursor *in, mp_value *into, int depth);

static bool read_children(cursor *in, mp_value *into, mp_type type, uint64_t count, int depth)
{
    uint64_t children = type == MP_MAP ? 2 * count : count;
    /* Each takes a byte at least: a count that cannot be is refused before anything is allocated for it. */
    if (depth >= DEEPEST || children > (uint64_t)(in->end - in->at)) return false;
    into->type = type;
    into->children = calloc(children ? (size_t)children : 1, sizeof *into->children);
    if (into->children == NULL) return false;
    for (into->count = 0; into->count < children; into->count++) {
        mp_value *child = &into->children[into->count];
        if (!read_value(in, child, depth + 1)) {
            into->count++;
            return false;
        }
        if (type == MP_MAP && into->count % 2 == 0 && child->type != MP_STR) {
            into->count++;
            return false;
        }
    }
    return true;
}

static bool read_integer(mp_value *into, bool is_signed, uint64_t value, int width)
{
    into->type = !is_signed && value > INT64_MAX ? MP_UINT : MP_INT;
    into->unsigned_integer = value;
    into->integer = is_signed ? extended(value, width) : (int64_t)value;
    return true;
}

static bool read_value(cursor *in, mp_value *into, int depth)
{
    uint64_t first, n;
    if (!number(in, 1, &first)) return false;
    if (first < 0x80) return read_integer(into, false, first, 1);
    if (first < 0x90) return read_children(in, into, MP_MAP, first & 0x0f, depth);
    if (first < 0xa0) return read_children(in, into, MP_ARRAY, first & 0x0f, depth);
    if (first < 0xc0) return read_bytes(in, into, MP_STR, first & 0x1f);
    if (first >= 0xe0) return read_integer(into, true, first, 1);
    switch (first) {
    case 0xc0: into->type = MP_NIL; return true;
    case 0xc2: case 0xc3: into->type = MP_BOOL; into->boolean = first == 0xc3; return true;
    case 0xc4: case 0xc5: case 0xc6: return number(in, 1 << (first - 0xc4), &n) && read_bytes(in, into, MP_BIN, n);
    case 0xcb:
        if (!number(in, 8, &n)) return false;
        into->type = MP_FLOAT;
        memcpy(&into->number, &n, sizeof n);
        return true;
    case 0xcc: case 0xcd: case 0xce: case 0xcf: {
        int width = 1 << (first - 0xcc);
        return number(in, width, &n) && read_integer(into, false, n, width);
    }
    case 0xd0: case 0xd1: case 0xd2: case 0xd3: {
        int width = 1 << (first - 0xd0);
        return number(in, width, &n) && read_integer(into, true, n, width);
    }
    case 0xd9: case 0xda: case 0xdb: return number(in, 1 << (first - 0xd9), &n) && read_bytes(in, into, MP_STR, n);
    case 0xdc: case 0xdd: return number(in, 2 << (first - 0xdc), &n) && read_children(in, into, MP_ARRAY, n, depth);
    case 0xde: case 0xdf: return number(in, 2 << (first - 0xde), &n) && read_children(in, into, MP_MAP, n, depth);
    default: return false;
    }
}

mp_value *mp_read(const uint8_t *bytes, size_t size)
{
    cursor in = {bytes, bytes + size};
    mp_value *value = calloc(1, sizeof *value);
    if (value != NULL && (!read_value(&in, value, 0) || in.at != in.end)) {
        mp_release(value);
        return NULL;
    }
    return value;
}

static void release_children(mp_value *value)
{
    for (uint32_t i = 0; i < value->count; i++) release_children(&value->children[i]);
    free(value->children);
}

void mp_release(mp_value *value)
{
    if (value == NULL) return;
    release_children(value);
    free(value);
}

bool mp_is(const mp_value *value, const char *string)
{
    return value != NULL && value->type == MP_STR && value->size == strlen(string) &&
           memcmp(value->bytes, string, value->size) == 0;
}

const mp_value *mp_field(const mp_value *map, const char *name)
{
    if (map == NULL || map->type != MP_MAP) return NULL;
    for (uint32_t i = 0; i < map->count; i += 2)
        if (mp_is(&map->children[i], name)) return &map->children[i + 1];
    return NULL;
}

static uint64_t little_at(const mp_value *bin, size_t index)
{
    uint64_t bits = 0;
    for (int i = 7; i >= 0; i--) bits = bits << 8 | bin->bytes[8 * index + (size_t)i];
    return bits;
}

int64_t mp_i64_at(const mp_value *bin, size_t index) { return (int64_t)little_at(bin, index); }

double mp_f64_at(const mp_value *bin, size_t index)
{
    uint64_t bits = little_at(bin, index);
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

void mp_write(mp_buffer *out, const mp_value *value)
{
    switch (value->type) {
    case MP_NIL: mp_nil(out); return;
    case MP_BOOL: mp_bool(out, value->boolean); return;
    case MP_INT: mp_int(out, value->integer); return;
    case MP_UINT: mp_uint(out, value->unsigned_integer); return;
    case MP_FLOAT: mp_float(out, value->number); return;
    case MP_STR: text(out, value->bytes, value->size); return;
    case MP_BIN: mp_bin(out, value->bytes, value->size); return;
    case MP_ARRAY: mp_array(out, value->count); break;
    case MP_MAP: mp_map(out, value->count / 2); break;
    }
    for (uint32_t i = 0; i < value->count; i++) mp_write(out, &value->children[i]);
}
