/* Reads golden messages, writes each back to the same bytes, and prints what is in it as its description has it.
 *
 *     ./vectors FILE.msgpack ...      one line of JSON for each; exit code 1 if one is not read, or not written the same
 */
#include "messagepack.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* What is in a bin, by the name of its field: §4, §10 and §15 to §17 of the contract; f64 where not said. */
static const char *const INTEGERS[] = {"keys", "others", "dims", "other_dims", "landmarks", "observations", "candidates",
                                       "factors", "ids", "stamps", "tried", NULL};
static const char *const BYTES[] = {"plausible", "matched", NULL};
static const char *const MESSAGES[] = {"payload", "ask", "shard", NULL};

static bool among(const mp_value *name, const char *const *names)
{
    for (; *names != NULL; names++)
        if (mp_is(name, *names)) return true;
    return false;
}

static bool print(const mp_value *value, const mp_value *name);

static void print_text(const mp_value *value)
{
    putchar('"');
    for (size_t i = 0; i < value->size; i++) {
        uint8_t byte = value->bytes[i];
        if (byte == '"' || byte == '\\') printf("\\%c", byte);
        else if (byte < 0x20) printf("\\u%04x", byte);
        else putchar(byte);
    }
    putchar('"');
}

/* 17 digits read back bit for bit; the point says that it is a float. */
static void print_float(double number)
{
    char digits[40];
    snprintf(digits, sizeof digits, "%.17g", number);
    printf("%s%s", digits, strpbrk(digits, ".en") ? "" : ".0");
}

static bool print_bin(const mp_value *value, const mp_value *name)
{
    if (among(name, MESSAGES)) {
        mp_value *inside = mp_read(value->bytes, value->size);
        bool fine = inside != NULL;
        printf("{\"msgpack\":");
        if (fine) fine = print(inside, NULL);
        putchar('}');
        mp_release(inside);
        return fine;
    }
    bool bytes = among(name, BYTES), integers = among(name, INTEGERS);
    if (!bytes && value->size % 8 != 0) return false;
    printf("{\"%s\":[", bytes ? "u8" : integers ? "i64" : "f64");
    for (size_t i = 0; i < (bytes ? value->size : value->size / 8); i++) {
        if (i > 0) putchar(',');
        if (bytes) printf("%u", value->bytes[i]);
        else if (integers) printf("%lld", (long long)mp_i64_at(value, i));
        else print_float(mp_f64_at(value, i));
    }
    printf("]}");
    return true;
}

static bool print(const mp_value *value, const mp_value *name)
{
    switch (value->type) {
    case MP_NIL: printf("null"); return true;
    case MP_BOOL: printf(value->boolean ? "true" : "false"); return true;
    case MP_INT: printf("%lld", (long long)value->integer); return true;
    case MP_UINT: printf("%llu", (unsigned long long)value->unsigned_integer); return true;
    case MP_FLOAT: print_float(value->number); return true;
    case MP_STR: print_text(value); return true;
    case MP_BIN: return print_bin(value, name);
    default: break;
    }
    bool map = value->type == MP_MAP;
    putchar(map ? '{' : '[');
    for (uint32_t i = 0; i < value->count; i++) {
        if (i > 0) putchar(map && i % 2 == 1 ? ':' : ',');
        bool key = map && i % 2 == 0;
        if (!print(&value->children[i], key ? NULL : map ? &value->children[i - 1] : name)) return false;
    }
    putchar(map ? '}' : ']');
    return true;
}

static bool check(const char *path)
{
    static uint8_t bytes[1 << 20];
    FILE *file = fopen(path, "rb");
    size_t size = file ? fread(bytes, 1, sizeof bytes, file) : 0;
    if (file) fclose(file);
    mp_value *message = mp_read(bytes, size);
    mp_buffer again = {0};
    bool fine = message != NULL;
    if (fine) {
        mp_write(&again, message);
        fine = !again.failed && again.size == size && memcmp(again.bytes, bytes, size) == 0 && print(message, NULL);
        putchar('\n');
    }
    if (!fine) fprintf(stderr, "%s: not read, or not written as it was\n", path);
    mp_free(&again);
    mp_release(message);
    return fine;
}

int main(int count, char **arguments)
{
    bool fine = count > 1;
    for (int i = 1; i < count; i++) fine = check(arguments[i]) && fine;
    return fine ? 0 : 1;
}
