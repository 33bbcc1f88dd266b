/* What the examples check of a message before they believe it: another process wrote it. */
#ifndef ROOMCAST_CHECK_H
#define ROOMCAST_CHECK_H

#include <stddef.h>
#include <stdint.h>

/* Whether a character controls a terminal, or makes text look like other text. */
static inline int is_hidden(uint32_t c) {
    return c < 0x20 || (c >= 0x7f && c <= 0x9f) || c == 0xad || c == 0x61c || c == 0x180e || (c >= 0x200b && c <= 0x200f) ||
           (c >= 0x2028 && c <= 0x202e) || (c >= 0x2060 && c <= 0x206f) || c == 0xfeff || (c >= 0xfff9 && c <= 0xfffb) ||
           (c >= 0xe0000 && c <= 0xe007f);
}

/* Whether a field is text that receivers take, also if it is empty: UTF-8, nothing hidden in it, and zeros behind it. */
static inline int is_text(const uint8_t *field, size_t size) {
    size_t at = 0;
    while (at < size && field[at] != 0) {
        uint8_t first = field[at++];
        int more = first < 0x80 ? 0 : first < 0xe0 ? 1 : first < 0xf0 ? 2 : 3;
        if ((first >= 0x80 && first < 0xc0) || first >= 0xf8) {
            return 0;
        }
        uint32_t c = more == 0 ? first : first & (0x3fu >> more);
        /* The first character that needs as many bytes; what takes more bytes than it needs is no UTF-8. */
        uint32_t least = more == 0 ? 0 : more == 1 ? 0x80 : more == 2 ? 0x800 : 0x10000;
        for (; more > 0; more--, at++) {
            if (at == size || (field[at] & 0xc0) != 0x80) {
                return 0;
            }
            c = c << 6 | (field[at] & 0x3fu);
        }
        if (c < least || (c >= 0xd800 && c <= 0xdfff) || c > 0x10ffff || is_hidden(c)) {
            return 0;
        }
    }
    for (; at < size; at++) {
        if (field[at] != 0) {
            return 0;
        }
    }
    return 1;
}

#endif
